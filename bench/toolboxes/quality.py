"""Effect of JPEG and H.264 compression on the project's detector: accuracy by data rate.

`python -m bench.toolboxes.quality [--weights FILE.onnx] [--out bench-out/toolbox_quality] [--plot FILE.png]`

Six cameras at level crossings, three of them at dusk (data_samples/crossing.py, 640 x 360, 25 images per second, 60
images each, seeds below those of training), and KITTI raw 0009, frames 0-24, at 10 per second (../shared/data), are
encoded as JPEGs with a quality and as H.264 streams with a bit rate (services/qos/encoding.py) and decoded; every third
image is evaluated.

- ap50: average precision (VOC 2010) at an overlap of one half, regardless of the class; occluded and small objects are
  ignored as in bench/toolboxes/detect.py.
- agreement: F1 of the boxes with a score above .3 relative to those in the original images.
- kitti_recall: share of KITTI's vehicles from 25 pixels of height that are detected with a score of .3.

Mbit/s are those of the encoded images alone. Ends with `RESULT {json}`: these metrics by encoding, and as `choice` the
lowest data rate of each kind whose agreement is at most .05 below that of JPEGs with quality 95. KITTI's metrics are
null without its data. Takes three minutes on one core.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bench.paths import DATA
from bench.toolboxes.detect import MIN_SIDE_PX, OWN_WEIGHTS, Detector, kitti_pictures
from scan2sim.data_samples import crossing
from scan2sim.pipeline.core.types import U8
from scan2sim.services.qos import encoding
from scan2sim.services.toolboxes import frames
from scan2sim.services.toolboxes.detector.agreement import MIN_SCORE, agreement
from scan2sim.services.toolboxes.detector.dataset import MIN_VISIBLE_SHARE
from scan2sim.services.toolboxes.detector.evaluate import VEHICLES
from scan2sim.services.toolboxes.detector.metrics import GroundTruth, Predictions, average_precision, match
from scan2sim.services.toolboxes.frames import Frame

SEED, VIEWS, IMAGES, IMAGE_STRIDE = 300, 6, 60, 3
FIRST_IMAGE = 50
"""First image of a view; there is traffic by then."""
KITTI, KITTI_RATE = "kitti_raw0009_f00-24", 10.0
MIN_HEIGHT_PX, MAX_AGREEMENT_LOSS = 25.0, 0.05
QUALITIES = (95, 90, 80, 70, 60, 50, 40, 30, 20, 10)
MEGABITS = (8.0, 4.0, 2.0, 1.0, 0.5, 0.25)

Encode = Callable[[Sequence[U8], float], tuple[int, list[U8]]]
"""From successive images and their rate to the total size in bytes and the decoded images."""


@dataclass(frozen=True)
class ImageSequence:
    """Successive images, their rate per second, and their truth."""

    images: list[U8]
    rate: float
    truth: list[GroundTruth]

    def evaluated(self, made: Sequence[U8]) -> list[U8]:
        """The images that the detector evaluates."""
        return list(made[::IMAGE_STRIDE])


def crossings() -> Iterator[ImageSequence]:
    """One sequence per view."""
    for number in range(VIEWS):
        view = crossing.view(SEED, number, (FIRST_IMAGE + IMAGES) / crossing.FPS)
        shown = [view.frame(index) for index in range(FIRST_IMAGE, FIRST_IMAGE + IMAGES)]
        yield ImageSequence([one.rgb for one in shown], crossing.FPS, [_truth(one.visible) for one in shown])


def _truth(seen: list[Any]) -> GroundTruth:
    corners = np.array([one.box for one in seen], np.float32).reshape(-1, 4)
    visible = np.array([one.visible for one in seen], np.float32)
    sides = (corners[:, 2:] - corners[:, :2]).max(axis=1, initial=0)
    return GroundTruth(corners, np.zeros(len(seen), np.int32), (visible < MIN_VISIBLE_SHARE) | (sides < MIN_SIDE_PX))


def kitti() -> list[ImageSequence]:
    """KITTI's vehicles, if available."""
    if not (DATA / KITTI).is_dir():
        return []
    images, truth = zip(*kitti_pictures(DATA / KITTI), strict=True)
    tall = [
        GroundTruth(t.corners, t.labels, t.ignored | (t.corners[:, 3] - t.corners[:, 1] < MIN_HEIGHT_PX)) for t in truth
    ]
    return [ImageSequence(list(images), KITTI_RATE, tall)]


def encodings() -> dict[str, Encode]:
    """Encoders by name."""

    def jpeg(quality: int) -> Encode:
        def encode(images: Sequence[U8], rate: float) -> tuple[int, list[U8]]:
            made = [encoding.jpeg(image, quality) for image in images]
            return sum(map(len, made)), [frames.rgb(Frame("", "", None, one, lambda _: None)) for one in made]

        return encode

    def h264(megabits: float) -> Encode:
        def encode(images: Sequence[U8], rate: float) -> tuple[int, list[U8]]:
            made = list(encoding.encode_h264(images, rate, megabits * 1e6))
            decoded = [_as_large(one, image) for one, image in zip(encoding.decode_h264(made), images, strict=True)]
            return sum(map(len, made)), decoded

        return encode

    return {
        **{f"jpeg {quality}": jpeg(quality) for quality in QUALITIES},
        **{f"h264 {megabits:g}": h264(megabits) for megabits in MEGABITS},
    }


def _as_large(decoded: U8, image: U8) -> U8:
    """Pad an odd row or column that was cropped by H.264 encoding."""
    more = [(0, a - b) for a, b in zip(image.shape, decoded.shape, strict=True)]
    return np.pad(decoded, more, "edge")


def accuracy(found: list[Predictions], truth: list[GroundTruth]) -> float:
    """Average precision over all classes as one."""
    return average_precision([Predictions(f.corners, f.scores, 0 * f.labels) for f in found], truth, 0)


def recall(found: list[Predictions], truth: list[GroundTruth], names: list[str]) -> float:
    """Share of KITTI's vehicles that are detected as any kind of vehicle."""
    own = [names.index(name) for name in VEHICLES]
    hits, known = 0, 0
    for one, true in zip(found, truth, strict=True):
        vehicle = np.isin(one.labels, own) & (one.scores >= MIN_SCORE)
        hit, _ = match(Predictions(one.corners[vehicle], one.scores[vehicle], 0 * one.labels[vehicle]), true)
        hits, known = hits + int((hit >= 0).sum()), known + int((~true.ignored).sum())
    return hits / max(1, known)


def study(detector: Detector) -> dict[str, dict[str, float | None]]:
    """Metrics of each encoding, and without compression."""
    names = detector.names
    streets, drives = list(crossings()), kitti()

    def detect(parts: list[ImageSequence], encode: Encode | None) -> tuple[float, list[Predictions]]:
        """Mbit/s, and detections."""
        megabits, found = [], []
        for part in parts:
            size, made = encode(part.images, part.rate) if encode else (0, part.images)
            megabits.append(8e-6 * size * part.rate / len(part.images))
            found += [detector.find(one, max(one.shape[:2]), 0.01) for one in part.evaluated(made)]
        return float(np.mean(megabits)) if megabits else float("nan"), found

    known, vehicles = ([t for part in parts for t in part.truth[::IMAGE_STRIDE]] for parts in (streets, drives))
    _, plain = detect(streets, None)
    results: dict[str, dict[str, float | None]] = {}
    for name, encode in {"none": None, **encodings()}.items():
        megabits, found = detect(streets, encode)
        kitti_megabits, kitti_found = detect(drives, encode)
        results[name] = {
            "megabits": round(megabits, 3),
            "ap50": round(accuracy(found, known), 4),
            "agreement": round(agreement(found, plain), 4),
            "kitti_megabits": round(kitti_megabits, 3) if drives else None,
            "kitti_recall": round(recall(kitti_found, vehicles, names), 4) if drives else None,
        }
        print(f"{name:10}" + "".join(f"{'-' if v is None else v:>14}" for v in results[name].values()), flush=True)
    return results


def choice(results: dict[str, dict[str, float | None]], kind: str) -> str | None:
    """The encoding of a kind with the lowest data rate such that little is lost from it upwards."""
    chosen = None
    for name in (one for one in results if one.startswith(kind)):  # best first
        if (results["jpeg 95"]["agreement"] or 0) - (results[name]["agreement"] or 0) > MAX_AGREEMENT_LOSS:
            break
        chosen = name
    return chosen


def plot(results: dict[str, dict[str, float | None]], file: Path) -> None:
    """Plot accuracy and agreement over Mbit/s, for the crossings."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    for axis, what, title in zip(axes, ("ap50", "agreement"), ("AP50", "agreement with uncompressed"), strict=True):
        for kind, label, colour in (("jpeg", "JPEG, by quality", "#d95f02"), ("h264", "H.264", "#1b7ab8")):
            curve = {name: row for name, row in results.items() if name.startswith(kind)}
            axis.plot([r["megabits"] for r in curve.values()], [r[what] for r in curve.values()], "o-", ms=4,
                      color=colour, label=label)  # fmt: skip
            for name, row in curve.items():
                if kind == "jpeg":
                    axis.annotate(name.split()[1], (row["megabits"], row[what]), fontsize=7, xytext=(3, -9),
                                  textcoords="offset points", color=colour)  # fmt: skip
        axis.set(xscale="log", xlabel="Mbit/s at 640 x 360, 25 images per second", title=title, ylim=(0, None))
        if what == "ap50":
            axis.axhline(results["none"]["ap50"], color="grey", lw=0.8, ls="--", label="uncompressed")
        axis.set_xticks([0.25, 0.5, 1, 2, 4, 8, 16], ["0.25", "0.5", "1", "2", "4", "8", "16"])
        axis.minorticks_off()
        axis.grid(alpha=0.3)
        axis.legend(loc="lower right", fontsize=8)
    figure.savefig(file, dpi=100)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", type=Path, default=OWN_WEIGHTS)
    parser.add_argument("--out", type=Path, default=Path("bench-out/toolbox_quality"))
    parser.add_argument("--plot", type=Path, help="file of the plot. Default: OUT/quality.png")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    print(f"{'':10}" + "".join(f"{name:>14}" for name in ("Mbit/s", "ap50", "agreement", "kitti Mbit/s", "recall")))
    results = study(Detector(given.weights))
    plot(results, given.plot or given.out / "quality.png")
    print(
        "RESULT",
        json.dumps({"encodings": results, "choice": {kind: choice(results, kind) for kind in ("jpeg", "h264")}}),
    )


if __name__ == "__main__":
    main()
