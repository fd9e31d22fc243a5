"""Findings about tiles that were read wrong, and none about right ones."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.core.types import F64, U8, Camera, Frame, PointCloud, View
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.plausibility import check
from scan2sim.pipeline.plausibility.check import check_tile, find_implausible
from tests.conftest import ROOT

ORIGIN = np.array([391_204.0, 5_820_376.0, 33.0])
CAMERA = Camera("pinhole", 640, 480, 500.0, 500.0, 320.0, 240.0)


def street(seed: int = 0, count: int = 60_000) -> F64:
    """Points (N, 3) of a street of 40 m with a row of houses and a cross wall, in UTM."""
    random = np.random.default_rng(seed)
    x, y, z = random.uniform(-20, 20, count), random.uniform(-12, 8, count), random.uniform(0, 7, count)
    ground, wall = np.arange(count) % 4 < 2, np.arange(count) % 4 == 2
    xyz = np.column_stack([np.where(ground | wall, x, 20), np.where(wall, 8, y), np.where(ground, 0.01 * x, z)])
    return xyz + random.normal(0, 0.005, xyz.shape) + ORIGIN


def write(folder: Path, xyz: F64, classification: U8 | None = None, classes: str = "") -> Path:
    """A tile of the points, with codes (N,) and the entries of `[classes]`."""
    frame = Frame("EPSG:32633", tuple(np.floor(xyz.mean(axis=0)).tolist()))
    folder.mkdir(exist_ok=True)
    local = (xyz - frame.origin).astype(np.float32)
    las.write(folder / "cloud.laz", PointCloud(frame, local, classification=classification))
    text = f'name = "street"\nclouds = ["cloud.laz"]\n[classes]\n{classes}'
    (folder / "tile.toml").write_text(text, encoding="utf-8")
    return folder / "tile.toml"


def with_cameras(path: Path, height: float, away: float = 0.0, pitch: float = 0.0) -> list[str]:
    """Findings about the tile, with cameras along the street at a height over the ground; `pitch` down, radians."""
    tile = read_tile(path)
    views = []
    for x in np.linspace(-15, 15, 7):
        T = np.eye(4)
        forward = np.array([np.cos(pitch), 0, -np.sin(pitch)])
        T[:3, :3] = np.column_stack([(0, -1, 0), np.cross(forward, (0, -1, 0)), forward])
        T[:3, 3] = ORIGIN + (x, away, height) - np.asarray(tile.frame.origin)
        views.append(View(f"photo{x}", CAMERA, T, path))
    return find_implausible(replace(tile, views=tuple(views)))


def as_float32(xyz: F64) -> F64:
    return xyz.astype(np.float32).astype(np.float64)


def with_outliers(xyz: F64) -> F64:
    return np.concatenate([xyz, ORIGIN + [(5000.0, 0, 0), (0, 9000, 0), (3, 0, 800)]])


def y_up(xyz: F64) -> F64:
    local = xyz - ORIGIN
    return local[:, [0, 2, 1]] * (1, 1, -1) + ORIGIN


WRONG: dict[str, tuple[Callable[[F64], F64], str]] = {
    "float32": (as_float32, "northings of 50 cm.*32-bit floats"),
    "thinned": (lambda xyz: np.round(xyz / 0.1) * 0.1, "rounded or thinned to a grid"),
    "outliers": (with_outliers, "[1-9] of [0-9,]+ sampled points are far from the rest: all extend over 9,0.. m"),
    "sparse": (lambda xyz: ORIGIN + 40 * (xyz[::30] - ORIGIN), "too far for the surfaces"),
    "y up": (y_up, "up seems to be y"),
}


@pytest.mark.parametrize("name", WRONG)
def test_clouds_that_were_read_or_written_wrong_are_named(tmp_path: Path, name: str) -> None:
    spoil, text = WRONG[name]
    found = check_tile(write(tmp_path / "tile", spoil(street())))
    assert len(found) == 1
    assert re.search(text, found[0]), found


def test_right_tiles_have_no_findings(tmp_path: Path) -> None:
    path = write(tmp_path / "tile", street())
    assert check_tile(path) == []
    for height, pitch in ((1.6, 0.0), (3.5, 0.3), (40.0, np.pi / 2 - 0.01), (60.0, 0.8)):  # vehicles; drones look down
        assert with_cameras(path, height, pitch=pitch) == []
    assert find_implausible(read_tile(ROOT / "data_samples" / "tile")) == []


@pytest.mark.parametrize(
    ("height", "text"), [(41.6, "41.6 m above the ground.*39.6"), (-36.0, "36.0 m below.*add 38.0 m")]
)
def test_heights_of_another_kind_are_named_with_the_difference(tmp_path: Path, height: float, text: str) -> None:
    (found,) = with_cameras(write(tmp_path / "tile", street()), height)
    assert re.search(text, found), found


def test_photos_of_another_place_are_named(tmp_path: Path) -> None:
    (found,) = with_cameras(write(tmp_path / "tile", street()), 2.0, away=400.0)
    assert "39" in found and "another place" in found


def test_the_worst_finding_comes_first_and_a_failed_check_costs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "tile", with_outliers(street()))
    assert ["the cameras are" in text for text in with_cameras(path, 50.0)] == [True, False]

    def fail(*_: object) -> None:
        raise MemoryError("no more")

    monkeypatch.setattr(check, "sample_points", fail)
    assert check_tile(path) == ["the plausibility of the tile couldn't be checked (MemoryError: no more)"]


@pytest.mark.parametrize(
    ("ground", "wall", "classes", "wrong"),
    [
        (2, 6, "", False),
        (11, 6, "", False),
        (1, 2, "", True),  # Paris-Lille-3D: 1 ground, 2 building
        (1, 8, "", True),  # DALES: 8 building
        (7, 11, "", True),  # Cityscapes: 7 road, 11 building
        (7, 11, '7 = "road"\n11 = "building"\n', False),
        (2, 2, "", False),  # a cliff is ground
        (1, 6, "", False),  # only buildings are classified
    ],
)
def test_codes_of_other_data_sets_are_reported(
    tmp_path: Path, ground: int, wall: int, classes: str, wrong: bool
) -> None:
    """Of `street`, every other point is ground."""
    codes = np.where(np.arange(60_000) % 4 < 2, ground, wall).astype(np.uint8)
    found = check_tile(write(tmp_path / "tile", street(), codes, classes))
    assert len(found) == wrong
    if wrong:
        assert found[0].startswith("100% of the classified points more than 4 m above") and "--classes" in found[0]
