"""Offsets of photos from the cloud are measured for each camera, and reported only where they are certain."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scan2sim.data_samples.street import generate
from scan2sim.pipeline.core.types import Tile
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.pose_check import check
from scan2sim.pipeline.pose_check.check import check_photos, measured_offsets, read_check
from scan2sim.pipeline.pose_check.photo_offset import CameraOffset


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A street with photos of a panoramic and three other cameras."""
    out = tmp_path_factory.mktemp("street") / "tile"
    generate(out, length=40.0, points=500_000, photos=40, seed=5, photo_width=480)
    return out


def moved(street: Path, right_m: float = 0.0, degrees: float = 0.0) -> Tile:
    """The tile with all cameras moved to their right, and turned to their right."""
    tile = read_tile(street)
    T, angle = np.eye(4), np.radians(degrees)
    T[[0, 0, 2, 2], [0, 2, 0, 2]] = np.cos(angle), np.sin(angle), -np.sin(angle), np.cos(angle)
    T[0, 3] = right_m
    return replace(tile, views=tuple(replace(view, T_world_cam=view.T_world_cam @ T) for view in tile.views))


def side(found: list[CameraOffset]) -> CameraOffset:
    """The offset of the camera that looks to the left."""
    return next(one for one in found if "left" in one.photo)


def test_mounting_errors_of_a_camera_are_measured(street: Path) -> None:
    correct = measured_offsets(moved(street))
    assert len(correct) == 3 and not any(one.notable or one.warning() for one in correct)
    given = side(correct).right_px or 0.0
    camera = next(view.camera for view in read_tile(street).views if "left" in view.name)
    for right_m, degrees in ((0.15, 0.0), (0.0, 0.5)):
        found = side(measured_offsets(moved(street, right_m, degrees)))
        expected = camera.fx * (np.radians(degrees) + right_m / found.distance_m)
        assert found.right_px is not None and abs(found.right_px - given - expected) < 0.35 * expected
        assert found.notable and found.constant and "px right" in str(found.warning())


def test_no_offset_is_reported_for_photos_of_another_place(street: Path) -> None:
    tile = read_tile(street)
    away = np.eye(4)
    away[0, 3] = 12.0
    views = tuple(replace(view, T_world_cam=away @ view.T_world_cam) for view in tile.views)
    found = measured_offsets(replace(tile, views=views))
    assert not any(one.notable for one in found)
    assert any("no offset from the cloud is measurable" in one.text() for one in found)


def test_result_is_written_next_to_the_tile(street: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        check, "measured_offsets", lambda _: [CameraOffset("a.jpg", 8, 1, 9.0, -2.0, 0.5, 9, 12, True, True)]
    )
    (warning,) = check_photos(street / "tile.toml", conventions=False)
    assert "the same in all of them: a.jpg and 7 others: 9.0 px right, 2.0 px up" in warning
    content = read_check(street)
    assert content is not None and content["warnings"] == [warning] and content["cameras"][0]["degrees"] == 0.5
