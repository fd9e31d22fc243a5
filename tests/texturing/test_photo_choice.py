"""Photos for backdrop and splats: at a distance from each other, and not too many."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.camera.renderer import look_at, pinhole
from scan2sim.pipeline.core.types import View
from scan2sim.texturing.backdrop.photos import choose

CAMERA = pinhole(64, 48, field=80)


def drive(number: int, step: float = 0.4) -> list[View]:
    """Photos along a line."""
    poses = [look_at((i * step, 0.0, 1.7), (i * step + 10, 0.0, 1.7)) for i in range(number)]
    return [View(str(i), CAMERA, pose, Path(f"{i}.png")) for i, pose in enumerate(poses)]


def rig(number: int, cameras: int) -> list[View]:
    """Photos of cameras that look around, all in one place."""
    angles = np.linspace(0, 2 * np.pi, cameras, endpoint=False)
    poses = [look_at((0.0, 0.0, 1.7), (np.cos(a), np.sin(a), 1.7)) for a in angles.tolist()]
    return [View(str(i), CAMERA, poses[i % cameras], Path(f"{i}.png")) for i in range(number)]


def test_photos_in_between_are_left_out() -> None:
    assert choose(drive(9), range(9), 0.8, 100) == [0, 2, 4, 6, 8]
    assert choose(drive(9), [1, 4, 5, 6], 0.8, 100) == [1, 4, 6]


def test_without_a_distance_all_are_used() -> None:
    assert choose(drive(9), range(9), 0.0, 100) == [*range(9)]


@pytest.mark.parametrize("spacing", [0.0, 0.5, 50.0])
def test_too_many_are_thinned_out_evenly(spacing: float) -> None:
    """Also without any distance, which can't be enlarged by a factor."""
    chosen = choose(drive(60), range(60), spacing, 10)
    assert 1 <= len(chosen) <= 10
    if spacing < 1:
        assert len(chosen) >= 7 and chosen[0] == 0 and np.diff(chosen).max() <= 2 * np.diff(chosen).min()


@pytest.mark.parametrize("spacing", [0.0, 1.0])
def test_photos_in_one_place_that_look_around_are_not_too_many(spacing: float) -> None:
    chosen = choose(rig(24, 6), range(24), spacing, 4)
    assert len(chosen) == len(set(chosen)) == 4


def test_no_photos_are_no_choice() -> None:
    assert choose([], [], 0.5, 10) == []
