"""Classes of real photos compared with ground-truth polygons drawn on ten of them, for three methods.

- photo: predicted by the network from each photo alone.
- scan: predicted by `scan2sim segment` on the imported street, where the network also sees the scan's channels.
- carried: classes of the points projected into the photos where there are points; those of `scan` elsewhere.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from bench.paths import ROOT
from bench.street.run import STREETS, build_world
from bench.street.run import scan2sim as run
from scan2sim.pipeline.core.classes import colour_of
from scan2sim.pipeline.core.types import U8, PointCloud, View
from scan2sim.pipeline.geometry.voxel_grid import sample
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.segmentation.backends import load
from scan2sim.segmentation.labels import CLASSES, code_of_index, index_of_code
from scan2sim.segmentation.metrics import Confusion, confusion
from scan2sim.segmentation.photos import Classifier, class_map
from scan2sim.segmentation.project_scan import ScanProjector

POLYGONS = ROOT / "tests" / "segmentation" / "kitti_polygons.json"
METHODS = ("photo", "scan", "carried")
UNLABELLED, SKY = 255, 200
"""Code of pixels outside all polygons, and a code for the sky, since 0 means unknown."""
VOXEL_M = 0.1
"""Size of a point when it is projected into photos, metres."""


def kitti(out: Path) -> dict[str, Confusion]:
    """Confusion by method over both streets; overlays of the photos are written to `out`."""
    truth: list[U8] = []
    predicted: dict[str, list[U8]] = {method: [] for method in METHODS}
    for name in STREETS:
        for view, by_method in _labelled(name, out / name):
            drawn = _truth(view)
            rgb = image.read_rgb(view.photo)
            rows = [rgb, *(0.5 * rgb + 0.5 * _colours()[codes] for codes in by_method.values())]
            image.write(out / f"{name}_{view.photo.stem}.png", np.concatenate(rows).astype(np.uint8))
            labelled = drawn != UNLABELLED
            truth.append(_codes()[drawn[labelled]])
            for method, codes in by_method.items():
                predicted[method].append(np.where(codes[labelled] == 0, SKY, codes[labelled]).astype(np.uint8))
    found = {method: confusion(np.concatenate(truth), np.concatenate(predicted[method])) for method in METHODS}
    for method, result in found.items():
        print(f"\nKITTI pixels, {method} ({SKY} is sky): mIoU {mean(result):.3f}\n{result.table()}", flush=True)
    return found


def mean(found: Confusion) -> float:
    """Mean intersection over union of all labelled classes."""
    return float(np.mean(list(found.iou.values())))


def _labelled(name: str, folder: Path) -> Iterator[tuple[View, dict[str, U8]]]:
    """The photos with polygons, and by method the LAS codes (H, W) of their pixels, 0 for the sky."""
    path, _ = build_world(STREETS[name], folder, run=False)
    run("segment", path / "tile.toml", "--out", folder / "predicted")
    tile = read_tile(path / "tile.toml")
    standing = next((folder / "predicted" / "steps" / "instances").rglob("cloud.npz"))  # without moving objects
    cloud = sample(PointCloud.load(standing), VOXEL_M)
    assert cloud.classification is not None
    scan, classifier = ScanProjector(cloud, VOXEL_M), Classifier(load("street", None), "street")
    for view in tile.views:
        if view.photo.name not in _polygons():
            continue
        rgb = image.read_rgb(view.photo)
        size = view.camera.width, view.camera.height
        alone = code_of_index()[class_map(classifier.probabilities(rgb, view.camera), size[::-1])[0]]
        pixels = cv2.imread(str(folder / "predicted" / "labels" / f"{Path(view.name).stem}.png"), cv2.IMREAD_GRAYSCALE)
        nearest, _ = scan.nearest(view, size)
        points = np.where(nearest >= 0, cloud.classification[nearest], UNLABELLED).astype(np.uint8)
        points = cv2.resize(points, size, interpolation=cv2.INTER_NEAREST)
        covered = index_of_code()[points] != UNLABELLED
        yield view, {"photo": alone, "scan": np.asarray(pixels), "carried": np.where(covered, points, pixels)}


def _polygons() -> dict[str, dict[str, list[dict[str, list[list[float]]]]]]:
    photos: dict[str, dict[str, list[dict[str, list[list[float]]]]]] = json.loads(POLYGONS.read_text("utf-8"))["photos"]
    return photos


def _truth(view: View) -> U8:
    """(H, W) indices of the drawn classes, `UNLABELLED` elsewhere."""
    drawn = np.full((view.camera.height, view.camera.width), UNLABELLED, np.uint8)
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
