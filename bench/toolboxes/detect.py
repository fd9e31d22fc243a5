"""The project's own detector, or another in YOLOv5's export format, on images with known boxes.

`python -m bench.toolboxes.detect [--weights FILE.onnx] [--parts synthetic kitti defaults time] [--out DIR]`

- synthetic: 240 images of streets and crossings with seeds below those of training. detect_ap50_synthetic is the mean
  over classes of the average precision (VOC 2010) at an overlap of one half, ap50 by class. Objects occluded by more
  than three quarters, or without a side of 12 pixels, are ignored.
- kitti: frames 0-24 of KITTI raw 0009 (../shared/data); cars, vans and trucks as one class. Boxes that are largely
  occluded, truncated or DontCare are ignored. Recall by height in pixels, and precision, at a score of `--threshold`;
  kitti_ap50 over all boxes from 25 pixels.
- defaults: `toolbox detect` with its default settings on frames of KITTI: kitti_vehicle_recall,
  kitti_vehicle_precision of vehicles from 25 pixels of height on (raw 0009), at the thresholds by class of the network
  (kitti_thresholds); people_false_per_photo: people and cyclists detected in 72 photos without any (raw 0009, raw 0013,
  odometry 04).
- time: CPU milliseconds per image on one thread, 640 x 384 and 384 x 256, and of pre- and postprocessing.

`--pictures` writes images with detections into OUT. Ends with `RESULT {json}`; null for parts that were not run.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnxruntime

from bench.paths import DATA, ROOT
from scan2sim.data_samples import boxes
from scan2sim.pipeline.core.types import U8
from scan2sim.services.toolboxes import yolo
from scan2sim.services.toolboxes.detector.dataset import MIN_VISIBLE_SHARE, read, read_image
from scan2sim.services.toolboxes.detector.evaluate import (
    MIN_HEIGHT_PX,
    VEHICLES,
    curve,
    vehicle_predictions,
)
from scan2sim.services.toolboxes.detector.metrics import GroundTruth, Predictions, average_precision, match
from scan2sim.services.toolboxes.tasks import Model
from scan2sim.services.toolboxes.tasks import detect as task

OWN_WEIGHTS = ROOT / "services" / "toolboxes" / "weights" / "vehicles.onnx"
PEOPLE = ("person", "cyclist")
SEED, IMAGES, MIN_SIDE_PX = 500, 240, 12.0
RAW_0009 = "kitti_raw0009_f00-24"
WITHOUT_PEOPLE = (RAW_0009, "kitti_raw0013_f62-83", "kitti_odo04_f00-24")
"""Drives whose photos show nobody."""
HEIGHTS = ((15, 25), (25, 40), (40, 80), (80, 1000))
PARTS = ("synthetic", "kitti", "defaults", "time")


class Detector:
    """A detector from an ONNX file, on one thread."""

    def __init__(self, weights: Path) -> None:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        self._session = onnxruntime.InferenceSession(weights, options, ["CPUExecutionProvider"])
        metadata = self._session.get_modelmeta().custom_metadata_map
        self.names: list[str] = json.loads(metadata["names"])

    def run(self, batch: Any) -> Any:
        """Network output (B, N, 5 + C) for a batch (B, 3, H, W)."""
        return self._session.run(None, {self._session.get_inputs()[0].name: batch})[0]

    def find(self, rgb: U8, size: int, threshold: float) -> Predictions:
        """Boxes in an image, resized to `size` pixels on its longer side."""
        image, transform = yolo.letterbox(rgb, size)
        got = yolo.decode(self.run(image[None])[0], transform, threshold)
        return Predictions(got.corners, got.scores, got.labels)


def synthetic(detector: Detector, out: Path, size: int) -> dict[str, Any]:
    """Average precision by class on images that are generated in `out` if missing."""
    for _ in boxes.write(out, IMAGES, SEED):
        pass
    known, names = read(out)
    found, truth = [], []
    for one in known:
        found.append(detector.find(read_image(one.image), size, 0.01))
        sides = (one.boxes[:, 2:] - one.boxes[:, :2]).max(axis=1, initial=0)
        truth.append(
            GroundTruth(
                one.boxes, one.classes.astype(np.int32), (one.visible < MIN_VISIBLE_SHARE) | (sides < MIN_SIDE_PX)
            )
        )
    ap = {name: round(average_precision(found, truth, k), 4) for k, name in enumerate(names)}
    return {"detect_ap50_synthetic": round(float(np.nanmean(list(ap.values()))), 4), "ap50": ap}


def kitti(detector: Detector, size: int, threshold: float) -> tuple[dict[str, Any], list[tuple[U8, Predictions]]]:
    """Recall by size, precision and average precision of vehicles; and the images with detections."""
    folder, count = DATA / RAW_0009, {bounds: [0, 0] for bounds in HEIGHTS}
    wanted, right, shown = 0, 0, []
    found, truth = [], []
    for rgb, true in kitti_pictures(folder):
        got = detector.find(rgb, size, 0.01)
        own = np.isin(got.labels, [detector.names.index(name) for name in VEHICLES if name in detector.names])
        vehicles = Predictions(got.corners[own], got.scores[own], np.zeros(int(own.sum()), np.int32))
        found.append(vehicles)
        truth.append(true)
        sure = vehicles.scores >= threshold
        best = Predictions(vehicles.corners[sure], vehicles.scores[sure], vehicles.labels[sure])
        shown.append((rgb, best))
        tall = true.corners[:, 3] - true.corners[:, 1]
        every = GroundTruth(true.corners, true.labels, true.ignored | (tall < HEIGHTS[0][0]))
        hit, left_out = match(best, every)
        wanted, right = wanted + int((~left_out).sum()), right + int((hit >= 0).sum())
        for low, high in HEIGHTS:
            of = (tall >= low) & (tall < high) & ~true.ignored
            count[low, high][0] += int(np.isin(np.flatnonzero(of), hit).sum())
            count[low, high][1] += int(of.sum())
    tall_ones = [GroundTruth(t.corners, t.labels, t.ignored | (t.corners[:, 3] - t.corners[:, 1] < 25)) for t in truth]
    recall = {f"{low}-{high}": f"{a} of {n}" for (low, high), (a, n) in count.items()}
    precision = round(right / max(wanted, 1), 4)
    ap = round(average_precision(found, tall_ones, 0), 4)
    return {"kitti_recall": recall, "kitti_precision": precision, "kitti_ap50": ap}, shown


def defaults(weights: Path) -> dict[str, Any]:
    """Recall and precision of vehicles and false boxes of people, of `toolbox detect` with default settings."""
    model = task.load(task.Params(weights=weights))
    found, truth = vehicles(model)
    _, right, total = curve(found, truth)
    photos = [photo for name in WITHOUT_PEOPLE for photo in sorted((DATA / name).rglob("image_*2/**/*.png"))]
    people, thresholds = 0, None
    for photo in photos:
        (body,) = model([np.ascontiguousarray(read_image(photo))])
        people, thresholds = people + sum(one.label in PEOPLE for one in body.detections or ()), body.threshold
    print(
        f"{total} vehicles: {right.sum()} of {len(right)} detections are right; {people} people in {len(photos)} photos"
    )
    return {
        "kitti_vehicle_recall": round(float(right.sum() / total), 3),
        "kitti_vehicle_precision": round(float(right.mean()), 3),
        "kitti_thresholds": thresholds,
        "people_false_per_photo": round(people / max(len(photos), 1), 3),
    }


def vehicles(model: Model) -> tuple[list[Predictions], list[GroundTruth]]:
    """Detected vehicles and KITTI's boxes in the photos of raw 0009, as one class."""
    found, truth = [], []
    for rgb, true in kitti_pictures(DATA / RAW_0009):
        (body,) = model([np.ascontiguousarray(rgb)])
        found.append(vehicle_predictions(body))
        small = true.corners[:, 3] - true.corners[:, 1] < MIN_HEIGHT_PX
        truth.append(GroundTruth(true.corners, true.labels, true.ignored | small))
    return found, truth


def kitti_pictures(folder: Path) -> Iterator[tuple[U8, GroundTruth]]:
    """Images and their vehicles; occluded, truncated and DontCare boxes are ignored."""
    rows = [
        line.split() for line in (folder / "tracking_gt_0001_frames_0-24.txt").read_text(encoding="utf-8").splitlines()
    ]
    for number, image in enumerate(sorted(folder.rglob("image_02/data/*.*"))):
        own = [r for r in rows if int(r[0]) == number and r[2] in ("Car", "Van", "Truck", "Tram", "Misc", "DontCare")]
        spared = [r[2] in ("DontCare", "Tram", "Misc") or float(r[3]) > 1 or int(r[4]) > 1 for r in own]
        corners = np.array([[float(v) for v in r[6:10]] for r in own], np.float32).reshape(-1, 4)
        yield read_image(image), GroundTruth(corners, np.zeros(len(own), np.int32), np.array(spared, bool))


def times(detector: Detector) -> dict[str, float]:
    """CPU milliseconds per image."""
    milliseconds = {}
    rgb = np.random.default_rng(0).integers(0, 255, (720, 1280, 3), np.uint8)
    for width, height in ((640, 384), (384, 256)):
        image, transform = yolo.letterbox(rgb, (height, width))
        output = detector.run(image[None])
        for name, work in (
            ("before", lambda size=(height, width): yolo.letterbox(rgb, size)),
            ("network", lambda image=image: detector.run(image[None])),
            ("after", lambda output=output, transform=transform: yolo.decode(output[0], transform)),
        ):
            spent = []
            for _ in range(15):
                start = time.process_time()
                work()
                spent.append(time.process_time() - start)
            milliseconds[f"{name}_{width}"] = round(1000 * float(np.median(spent)), 2)
    return milliseconds


def drawn(rgb: U8, found: Predictions, names: list[str] | None = None) -> U8:
    """The image with boxes, BGR."""
    out = rgb[..., ::-1].copy()
    for (x0, y0, x1, y1), score, label in zip(found.corners, found.scores, found.labels, strict=True):
        cv2.rectangle(out, (int(x0), int(y0)), (int(x1), int(y1)), (0, 0, 255), 2)
        text = f"{names[label] if names else ''} {score:.2f}"
        cv2.putText(out, text, (int(x0), int(y0) - 3), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 255, 255), 1)
    return out


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", type=Path, default=OWN_WEIGHTS)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--out", type=Path, default=Path("bench-out/toolbox_detect"))
    parser.add_argument("--threshold", type=float, default=0.3)
    parser.add_argument("--size", type=int, default=640, help="longer side of synthetic images, pixels")
    parser.add_argument("--kitti-size", type=int, default=1242, help="longer side of KITTI's images, pixels")
    parser.add_argument("--pictures", action="store_true", help="write images with detections")
    a = parser.parse_args()
    detector = Detector(a.weights)
    result: dict[str, Any] = dict.fromkeys(
        (
            "detect_ap50_synthetic", "ap50", "kitti_recall", "kitti_precision", "kitti_ap50", "kitti_vehicle_recall",
            "kitti_vehicle_precision", "kitti_thresholds", "people_false_per_photo", "cpu_ms",
        )
    )  # fmt: skip
    a.out.mkdir(parents=True, exist_ok=True)
    if "synthetic" in a.parts:
        result |= synthetic(detector, a.out / "synthetic", a.size)
    if "kitti" in a.parts and (DATA / RAW_0009).is_dir():
        scores, shown = kitti(detector, a.kitti_size, a.threshold)
        result |= scores
        if a.pictures:
            for i, (rgb, found) in enumerate(shown):
                cv2.imwrite(str(a.out / f"kitti_{i:02d}.jpg"), drawn(rgb, found))
    if "defaults" in a.parts and (DATA / RAW_0009).is_dir():
        result |= defaults(a.weights)
    if "time" in a.parts:
        result["cpu_ms"] = times(detector)
    print("RESULT", json.dumps(result))


if __name__ == "__main__":
    main()
