"""Classification and segmentation with pretrained networks, compared with ground truth (parts `classes`, `pixels`).

- classes: crops of KITTI's unoccluded cars and vans at least 60 pixels high (frames 0-24 of raw 0009): correct if the
  likeliest ImageNet class is a motor vehicle (`VEHICLES`). A small test of a single kind of object; no other labelled
  photos are available.
- pixels: photos of synthetic streets with seeds below those of training, without scan channels: mean intersection over
  union over `segmentation.metrics.MEAN_OF`.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np

from bench.toolboxes.tracks import KITTI, TRUTH
from scan2sim.data_samples import training
from scan2sim.pipeline.core.types import U8
from scan2sim.segmentation.labels import code_of_index
from scan2sim.segmentation.metrics import confusion
from scan2sim.services.toolboxes.tasks import classify, segment

MIN_HEIGHT_PX = 60.0
VEHICLES = frozenset(
    (
        "ambulance", "beach wagon", "cab", "convertible", "fire engine", "garbage truck", "go-kart", "golfcart", "jeep",
        "limousine", "minibus", "minivan", "Model T", "moving van", "passenger car", "pickup", "police van", "racer",
        "recreational vehicle", "sports car", "tow truck", "tractor", "trailer truck", "school bus", "trolleybus",
    )
)  # fmt: skip
"""ImageNet classes below WordNet's "motor vehicle", and buses."""
SEED, IMAGES = 900, 40


def classes() -> dict[str, float] | None:
    """Share of vehicle crops with a vehicle as likeliest class; None without the data."""
    if not TRUTH.exists():
        print(f"classes: skipped, {TRUTH} doesn't exist")
        return None
    model = classify.load(classify.Params(whole=True))
    right = [
        body.classes[0].label in VEHICLES for body in (model([one])[0] for one in _vehicle_crops()) if body.classes
    ]
    top1 = float(np.mean(right))
    print(f"classes: {len(right)} vehicles cropped from KITTI, {top1:.3f} with a vehicle as likeliest class")
    return {"classify_top1": round(top1, 3)}


def _vehicle_crops() -> list[U8]:
    photos = sorted(KITTI.rglob("image_02/data/*.png"))
    found = []
    for line in TRUTH.read_text(encoding="utf-8").splitlines():
        words = line.split()
        left, top, right, bottom = (round(float(word)) for word in words[6:10])
        if words[2] in ("Car", "Van") and words[3] == words[4] == "0" and bottom - top >= MIN_HEIGHT_PX:
            image = cv2.imread(str(photos[int(words[0])]))
            found.append(np.ascontiguousarray(image[max(0, top) : bottom, max(0, left) : right, ::-1]))
    return found


def pixels(out: Path) -> dict[str, float]:
    """Mean intersection over union of the segmentation."""
    folder = out / "labelled-streets"
    render = [sys.executable, "-m", training.__name__, str(folder), "--images", str(IMAGES), "--seed", str(SEED)]
    subprocess.run(render, check=True, stdout=subprocess.DEVNULL)  # a child process, as forking breaks networks
    model, codes = segment.load(segment.Params()), code_of_index()
    known, predicted = [], []
    for path in sorted((folder / "images").glob("*.jpg")):
        (body,) = model([np.ascontiguousarray(cv2.imread(str(path))[..., ::-1])])
        assert body.segmentation
        label = cv2.imread(str(folder / "labels" / f"{path.stem}.png"), cv2.IMREAD_GRAYSCALE)
        mask = cv2.resize(segment.mask_of(body.segmentation), label.shape[::-1], interpolation=cv2.INTER_NEAREST)
        known.append(label[label != 255])
        predicted.append(codes[mask][label != 255])
    found = confusion(np.concatenate(known), np.concatenate(predicted))
    print(f"pixels: {len(known)} photos\n{found.table()}")
    return {"segment_miou": round(found.mean(), 3)}
