"""Classification by shape on a synthetic street with known classes, and on real data if available."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import Frame, PointCloud
from scan2sim.pipeline.importers.clouds_and_photos import import_las
from scan2sim.pipeline.io import clouds
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.segmentation.geometric import classify, split_ground
from scan2sim.segmentation.steps.segment import SEGMENT, SegmentParams, segment
from tests.present import present

GROUPS = {2: "ground", 3: "plant", 4: "plant", 5: "plant", 6: "building", 68: "building", 65: "pole", 66: "vehicle"}


def plane(rng: np.random.Generator, n: int, corner: list[float], a: list[float], b: list[float]) -> np.ndarray:
    s, t = rng.uniform(size=(2, n, 1))
    return np.array(corner) + s * np.array(a) + t * np.array(b) + rng.normal(0, 0.01, (n, 3))


def box(rng: np.random.Generator, n: int, low: list[float], size: list[float]) -> np.ndarray:
    """Points on the sides and the top of a box."""
    x, y, z = (np.eye(3) * size).tolist()
    corner, far = low, np.add(low, size).tolist()
    sides = [(corner, x, z), (corner, y, z), (far, [-v for v in x], [-v for v in z])]
    sides += [(far, [-v for v in y], [-v for v in z]), (far, [-v for v in x], [-v for v in y])]
    area = np.array([np.linalg.norm(np.cross(a, b)) for _, a, b in sides])
    shares = (n * area / area.sum()).astype(int)
    return np.concatenate([plane(rng, m, c, a, b) for m, (c, a, b) in zip(shares.tolist(), sides, strict=True)])


def blob(rng: np.random.Generator, n: int, centre: list[float], radius: float) -> np.ndarray:
    direction = rng.normal(size=(n, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return np.array(centre) + direction * radius * rng.uniform(0.2, 1, (n, 1)) ** (1 / 3)


def street(slope: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """A street of 40 x 30 m: ground, a house, a garden wall, two trees, a hedge, two cars, two poles."""
    rng = np.random.default_rng(5)
    parts = [
        (2, plane(rng, 60_000, [0, 0, 0], [40, 0, 0], [0, 30, 0])),
        (6, box(rng, 30_000, [5, 20, 0], [20, 8, 7])),
        (68, plane(rng, 5_000, [28, 22, 0], [10, 0, 0], [0, 0, 1.6])),
        (5, blob(rng, 6_000, [32, 6, 5], 2.5)),
        (5, blob(rng, 6_000, [8, 4, 4.5], 2.0)),
        (4, blob(rng, 4_000, [20, 3, 0.9], 0.9)),
        *[(66, box(rng, 3_000, [x, 10, 0.25], [4.2, 1.7, 0.7])) for x in (6, 14)],
        *[(66, box(rng, 1_500, [x + 1, 10.15, 0.9], [2.2, 1.4, 0.6])) for x in (6, 14)],
    ]
    for x in (12.0, 25.0):
        turn, up = rng.uniform(0, 2 * np.pi, 1500), rng.uniform(0, 5, 1500)
        parts.append((65, np.stack([x + 0.08 * np.cos(turn), 15 + 0.08 * np.sin(turn), up], axis=1)))
    xyz = np.concatenate([points for _, points in parts])
    xyz[:, 2] += slope * xyz[:, 0]
    return xyz.astype(np.float32), np.concatenate([np.full(len(points), code) for code, points in parts])


def recalls(classification: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    predicted, true = (
        np.array([GROUPS.get(code, "none") for code in codes.tolist()]) for codes in (classification, truth)
    )
    return {group: float(np.mean(predicted[true == group] == group)) for group in set(GROUPS.values())}


@pytest.mark.parametrize("slope", [0.0, 0.06])
def test_street_is_classified_correctly(slope: float) -> None:
    xyz, truth = street(slope)
    classification = classify(PointCloud(Frame(), xyz))
    recall = recalls(classification, truth)
    bars = {"ground": 0.98, "building": 0.95, "plant": 0.9, "vehicle": 0.8, "pole": 0.8}
    assert all(recall[group] >= bar for group, bar in bars.items()), recall
    predicted = recalls(truth, classification)  # with swapped arguments: precision
    assert all(predicted[group] >= 0.8 for group in bars), predicted


def test_vegetation_is_classified_by_height() -> None:
    xyz, truth = street()
    classification = classify(PointCloud(Frame(), xyz))
    tall, hedge = classification[(truth == 5) & (xyz[:, 2] > 3)], classification[(truth == 4) & (xyz[:, 2] > 0.7)]
    assert np.mean(tall == CODE["high_vegetation"]) > 0.9
    assert np.mean(hedge == CODE["mid_vegetation"]) > 0.8


def test_classification_is_deterministic() -> None:
    cloud = PointCloud(Frame(), street()[0])
    assert np.array_equal(classify(cloud), classify(cloud))


def test_isolated_roof_is_not_ground() -> None:
    rng = np.random.default_rng(0)
    ground = plane(rng, 8_000, [0, 0, 0], [10, 0, 0], [0, 40, 0])
    roof = plane(rng, 20_000, [25, 0, 9], [40, 0, 0], [0, 40, 0])
    height, is_ground = split_ground(np.concatenate([ground, roof]).astype(np.float32))
    assert is_ground[:8_000].mean() > 0.98 and is_ground[8_000:].mean() < 0.02
    assert abs(np.median(height[8_000:]) - 9) < 0.5


@pytest.mark.parametrize("n", [0, 1, 5, 50, 300])
def test_tiny_clouds_are_classified_without_error(n: int) -> None:
    rng = np.random.default_rng(n)
    for spread in ([5, 5, 5], [5, 5, 0], [0, 0, 5], [0, 0, 0]):
        xyz = (rng.uniform(size=(n, 3)) * spread).astype(np.float32)
        assert classify(PointCloud(Frame(), xyz)).shape == (n,)


def test_cloud_keeps_its_classes_unless_overwritten(tmp_path: Path) -> None:
    xyz, truth = street()
    cloud = PointCloud(Frame(), xyz, classification=truth.astype(np.uint8), time=np.arange(len(xyz), dtype=np.float64))
    cloud.save(tmp_path / "in.npz")
    inputs = {"cloud": tmp_path / "in.npz"}

    def run(name: str, **params: Any) -> tuple[PointCloud, dict[str, Any]]:
        (tmp_path / name).mkdir()
        done = segment(inputs, SegmentParams(**params), tmp_path / name, silent)
        return PointCloud.load(done.files["cloud"]), done.metrics

    kept, metrics = run("kept")
    assert np.array_equal(present(kept.classification), truth) and metrics["source"] == "cloud"
    assert metrics["points"]["terrain"] == int((truth == 2).sum())
    replaced, metrics = run("replaced", overwrite=True)
    assert metrics["source"] == "shape" and not np.array_equal(present(replaced.classification), truth)
    assert np.array_equal(present(replaced.time), present(cloud.time)) and np.array_equal(replaced.xyz, xyz)

    replace(cloud, classification=np.where(np.arange(len(xyz)) % 10 == 0, truth, 1).astype(np.uint8)).save(
        inputs["cloud"]
    )
    assert run("few")[1]["source"] == "shape"  # classes of a tenth of the points are not enough
    assert run("enough", min_classified=0.05)[1]["source"] == "cloud"
    replace(cloud, classification=None).save(inputs["cloud"])
    assert run("none", min_classified=0.0)[1]["source"] == "shape"
    assert SEGMENT.name == "segment"


def test_classes_of_an_airborne_survey_agree_with_its_own(real_data: Path, tmp_path: Path) -> None:
    tile = read_tile(import_las(sorted((real_data / "las").glob("ign_77*.laz")), tmp_path / "tile"))
    cloud = PointCloud.join([clouds.read(path, tile.frame) for path in tile.clouds])
    assert cloud.classification is not None
    known = np.isin(cloud.classification, (2, 3, 4, 5, 6))
    classification, truth = classify(cloud)[known], cloud.classification[known]
    for group, bar in (("ground", 0.97), ("plant", 0.72), ("building", 0.76)):
        codes = [code for code, name in GROUPS.items() if name == group]
        predicted, true = np.isin(classification, codes), np.isin(truth, codes)
        assert (predicted & true).sum() / (predicted | true).sum() > bar, group


def on_grid(xyz: np.ndarray, truth: np.ndarray, size: float, noise: float, how: str) -> tuple[np.ndarray, np.ndarray]:
    """One noisy point, or the centre, of every voxel; voxels with several classes are left out of the truth (0)."""
    rng = np.random.default_rng(1)
    xyz = xyz + rng.normal(0, noise, xyz.shape)
    cells, index = np.unique(np.floor(xyz / size).astype(np.int64), axis=0, return_inverse=True)
    index = index.ravel()
    first, low, high = (np.zeros(len(cells), np.int64) for _ in range(3))
    order = rng.permutation(len(xyz))
    first[index[order]] = order
    low[:], high[:] = 255, 0
    np.minimum.at(low, index, truth)
    np.maximum.at(high, index, truth)
    points = (cells + 0.5) * size if how == "centres" else xyz[first]
    return points.astype(np.float32), np.where(low == high, truth[first], 0)


@pytest.mark.parametrize(
    ("size", "noise", "how"),
    [(0.5, 0.0, "points"), (0.5, 0.1, "points"), (0.5, 0.0, "centres"), (0.2, 0.1, "points"), (0.1, 0.03, "points")],
)
@pytest.mark.parametrize("slope", [0.0, 0.06])
def test_sparse_and_noisy_maps_keep_ground_and_buildings(size: float, noise: float, how: str, slope: float) -> None:
    xyz, truth = on_grid(*street(slope), size, noise, how)
    classification = classify(PointCloud(Frame(), xyz), spacing=size)
    standing = ~np.isin(classification, (CODE["terrain"], CODE["unclassified"]))
    assert standing[truth == CODE["terrain"]].mean() < 0.03
    recall = recalls(classification, truth)
    assert recall["ground"] > 0.95
    if how == "points":
        assert recall["building"] > 0.7
        assert recall["plant"] > 0.6


def test_low_walls_of_a_map_without_ground_are_not_ground() -> None:
    """A map without ground points, with walls from 20 cm to 1 m, which must not be classified as noisy ground."""
    rng = np.random.default_rng(0)
    walls = [plane(rng, 6000, [0, y, 0.2], [60, 0, 0], [0, 0, 0.8]) for y in (0.0, 8.0)]
    xyz = (np.concatenate(walls) + rng.normal(0, 0.05, (12_000, 3))).astype(np.float32)
    ground = classify(PointCloud(Frame(), xyz), spacing=0.15) == CODE["terrain"]
    assert (xyz[ground, 2] < 0.6).all() and ground.mean() < 0.5
