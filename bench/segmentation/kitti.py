"""Classes of real photos against polygons drawn on ten of them, told in three ways.

- photo: by the network from each photo alone.
- scan: by `scan2sim segment` on the imported street, where the network sees the scan's channels as well.
- carried: what that told of the points, drawn back into the photos where there are points; `scan` elsewhere.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from bench.paths import ROOT
from bench.street.run import STREETS, made
from bench.street.run import scan2sim as run
from scan2sim.pipeline.core.classes import colour_of
from scan2sim.pipeline.core.types import U8, PointCloud, View
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.steps.voxel import sample
from scan2sim.segmentation.backends import load
from scan2sim.segmentation.labels import CLASSES, code_of_index, index_of_code
from scan2sim.segmentation.metrics import Confusion, confusion
from scan2sim.segmentation.photos import Classifier, class_map
from scan2sim.segmentation.project_scan import Drawn

POLYGONS = ROOT / "tests" / "segmentation" / "kitti_polygons.json"
WAYS = ("photo", "scan", "carried")
NONE, SKY = 255, 200
"""What no polygon is on, and a code for the sky: 0 says unknown."""
VOXEL = 0.1
"""Metres of the squares that points are carried back by."""


def kitti(out: Path) -> dict[str, Confusion]:
    """Both streets, by way; overlays of the photos in `out`."""
    known: list[U8] = []
    predicted: dict[str, list[U8]] = {way: [] for way in WAYS}
    for name in STREETS:
        for view, by_way in _labelled(name, out / name):
            drawn = _drawn(view)
            rgb = image.read_rgb(view.photo)
            rows = [rgb, *(0.5 * rgb + 0.5 * _colours()[codes] for codes in by_way.values())]
            image.write(out / f"{name}_{view.photo.stem}.png", np.concatenate(rows).astype(np.uint8))
            some = drawn != NONE
            known.append(_codes()[drawn[some]])
            for way, codes in by_way.items():
                predicted[way].append(np.where(codes[some] == 0, SKY, codes[some]).astype(np.uint8))
    found = {way: confusion(np.concatenate(known), np.concatenate(predicted[way])) for way in WAYS}
    for way, result in found.items():
        print(f"\nKITTI pixels, {way} ({SKY} is sky): mIoU {mean(result):.3f}\n{result.table()}", flush=True)
    return found


def mean(found: Confusion) -> float:
    """Mean intersection over union of all classes that were drawn."""
    return float(np.mean(list(found.iou.values())))


def _labelled(name: str, folder: Path) -> Iterator[tuple[View, dict[str, U8]]]:
    """The photos that polygons were drawn on, and LAS codes (H, W), 0 for the sky, by way."""
    path, _ = made(STREETS[name], folder, run=False)
    run("segment", path / "tile.toml", "--out", folder / "told")
    tile = read_tile(path / "tile.toml")
    standing = next((folder / "told" / "steps" / "things").rglob("cloud.npz"))  # without what moved, which is elsewhere
    cloud = sample(PointCloud.load(standing), VOXEL)
    assert cloud.classification is not None
    scan, classifier = Drawn(cloud, VOXEL), Classifier(load("street", None), "street")
    for view in tile.views:
        if view.photo.name not in _polygons():
            continue
        rgb = image.read_rgb(view.photo)
        size = view.camera.width, view.camera.height
        alone = code_of_index()[class_map(classifier.probabilities(rgb, view.camera), size[::-1])[0]]
        pixels = cv2.imread(str(folder / "told" / "labels" / f"{Path(view.name).stem}.png"), cv2.IMREAD_GRAYSCALE)
        nearest, _ = scan.nearest(view, size)
        points = np.where(nearest >= 0, cloud.classification[nearest], NONE).astype(np.uint8)
        points = cv2.resize(points, size, interpolation=cv2.INTER_NEAREST)
        there = index_of_code()[points] != NONE
        yield view, {"photo": alone, "scan": np.asarray(pixels), "carried": np.where(there, points, pixels)}


def _polygons() -> dict[str, dict[str, list[dict[str, list[list[float]]]]]]:
    photos: dict[str, dict[str, list[dict[str, list[list[float]]]]]] = json.loads(POLYGONS.read_text("utf-8"))["photos"]
    return photos


def _drawn(view: View) -> U8:
    """(H, W) indices of the classes that were drawn, `NONE` elsewhere."""
    drawn = np.full((view.camera.height, view.camera.width), NONE, np.uint8)
    for polygon in _polygons()[view.photo.name]["polygons"]:
        points = np.array(polygon["points"], np.float64).round().astype(np.int32)
        cv2.fillPoly(drawn, [points], CLASSES.index(str(polygon["class"])))
    return drawn


def _codes() -> U8:
    codes = code_of_index()
    codes[CLASSES.index("sky")] = SKY
    return codes


def _colours() -> U8:
    colours = colour_of()
    colours[0] = (135, 190, 230)
    return colours
