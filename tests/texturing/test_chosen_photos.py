"""Photos chosen for the backdrop and the splats: apart from each other, and never more than asked for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.camera.renderer import look_at, pinhole
from scan2sim.pipeline.core.types import F64, View
from scan2sim.texturing.backdrop.photos import choose

CAMERA = pinhole(8, 6)


def photo(position: F64, target: F64) -> View:
    """A photo at a position (3,) m that looks at a target (3,) m."""
    return View("photo", CAMERA, look_at(position, target), Path("photo.png"))


def drive(number: int) -> list[View]:
    """Photos every metre along x that look ahead."""
    return [photo(np.array([x, 0.0, 0.0]), np.array([x + 1.0, 0.0, 0.0])) for x in range(number)]


def around(number: int) -> list[View]:
    """Photos from one point in directions all around."""
    angles = np.arange(number) * 2 * np.pi / number
    return [photo(np.zeros(3), np.array([np.cos(angle), np.sin(angle), 0.0])) for angle in angles]


def test_photos_have_the_spacing() -> None:
    assert choose(drive(10), range(10), 2.0, 10) == [0, 2, 4, 6, 8]


@pytest.mark.parametrize("spacing", [0.0, 0.5, 1000.0])
@pytest.mark.parametrize("views", [drive(50), around(6), drive(30) + around(9)], ids=["drive", "rig", "both"])
def test_no_more_photos_than_asked_for(views: list[View], spacing: float) -> None:
    chosen = choose(views, range(len(views)), spacing, 4)
    assert 1 <= len(chosen) <= 4 and sorted(set(chosen)) == chosen


def test_spacing_of_zero_uses_all_photos() -> None:
    assert choose(drive(5), [0, 1, 2, 4], 0.0, 10) == [0, 1, 2, 4]
    assert choose([], [], 0.0, 10) == []
