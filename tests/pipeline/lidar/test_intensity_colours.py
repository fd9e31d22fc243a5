"""Colours from intensity: lane markings painted on a synthetic road stay visible at all ranges."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import Bools, Frame, PointCloud, Trajectory
from scan2sim.pipeline.lidar.intensity import has_intensity
from scan2sim.pipeline.lidar.intensity_colours import intensity_colours
from scan2sim.pipeline.steps.map_colours import MapColoursParams, map_colours


def road(spacing: float, noise: float = 0.1, scale: float = 20_000) -> tuple[PointCloud, Bools]:
    """A road of 60 x 12 m whose intensity falls with the distance from its middle, and which points are markings."""
    rng = np.random.default_rng(2)
    x, y = np.meshgrid(np.arange(-30, 30, spacing), np.arange(-6, 6, spacing))
    xyz = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    xyz[:, :2] += rng.uniform(-spacing / 3, spacing / 3, (x.size, 2))
    marking = (np.abs(xyz[:, 1]) < 0.15) & (xyz[:, 0] % 9 < 4)  # a dashed line of 30 cm
    marking |= np.abs(np.abs(xyz[:, 1]) - 5) < 0.15
    reflectivity = np.where(marking, 0.6, 0.2) * rng.normal(1, noise, len(xyz))
    distance = np.linalg.norm(xyz - [0, 0, 2], axis=1)
    intensity = np.clip(scale * reflectivity / (1 + (distance / 15) ** 2), 0, 65535).astype(np.uint16)
    code = np.full(len(xyz), CODE["terrain"], np.uint8)
    return PointCloud(Frame(), xyz.astype(np.float32), classification=code, intensity=intensity), marking


@pytest.mark.parametrize("known_path", [False, True])
@pytest.mark.parametrize("spacing", [0.1, 0.2])
def test_markings_are_lighter_than_the_road_at_all_ranges(spacing: float, known_path: bool) -> None:
    cloud, marking = road(spacing)
    path = Trajectory(np.arange(2.0), np.array([[-1.0, 0, 2], [1, 0, 2]])) if known_path else None
    light = intensity_colours(cloud, path).mean(axis=1)
    threshold = 165
    assert np.mean((light > threshold)[marking]) > 0.9
    assert np.mean((light > threshold)[~marking]) < 0.05
    far = np.abs(cloud.xyz[:, 0]) > 20
    assert np.mean((light > threshold)[marking & far]) > 0.8


def test_lowest_points_of_bright_walls_are_no_markings_of_the_floor() -> None:
    """Noise makes them points of the floor; markings elsewhere on it stay white."""
    cloud, marking = road(0.1)
    assert cloud.classification is not None and cloud.intensity is not None
    cloud.classification[:] = CODE["floor"]
    wall = np.abs(cloud.xyz[:, 1]) > 5.9
    foot = (np.abs(cloud.xyz[:, 1]) > 5.75) & ~wall
    cloud.classification[wall] = CODE["wall"]
    cloud.intensity[wall | foot] *= 3
    light = intensity_colours(cloud).mean(axis=1)
    assert np.median(light[foot]) < 1.2 * np.median(light[~(wall | foot | marking)])
    assert np.mean(light[marking] > 200) > 0.8


def test_shades_are_independent_of_the_unit_of_the_intensity() -> None:
    low, high = (intensity_colours(road(0.2, scale=scale)[0]).mean(axis=1) for scale in (800, 60_000))
    assert np.median(np.abs(low - high)) < 8


def test_vegetation_keeps_a_green_tint() -> None:
    cloud, _ = road(0.3)
    assert cloud.classification is not None
    cloud.classification[: len(cloud) // 2] = CODE["high_vegetation"]
    rgb = intensity_colours(cloud)[: len(cloud) // 2].astype(int)
    assert (rgb[:, 1] > rgb[:, 0]).all() and (rgb[:, 1] > rgb[:, 2]).all()


def test_map_without_intensity_gets_class_colours(tmp_path: Path) -> None:
    cloud, _ = road(0.5)
    assert cloud.intensity is not None
    cloud.intensity[:] = 7
    assert not has_intensity(cloud)
    cloud.save(tmp_path / "in.npz")
    done = map_colours({"cloud": tmp_path / "in.npz"}, MapColoursParams(), tmp_path, silent)
    assert done.metrics["source"] == "classes"
    assert PointCloud.load(done.files["cloud"]).rgb is None


def test_empty_and_tiny_clouds_are_accepted(tmp_path: Path) -> None:
    cloud, _ = road(0.5)
    for n in (0, 1, 25):
        cloud.take(slice(n)).save(tmp_path / "in.npz")
        done = map_colours({"cloud": tmp_path / "in.npz"}, MapColoursParams(), tmp_path, silent)
        assert len(PointCloud.load(done.files["cloud"])) == n
        done.files["cloud"].unlink()
