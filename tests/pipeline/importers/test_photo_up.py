"""The up direction of photos does not follow how they are pitched."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.importers.photo_up import up_of_photos

LEVEL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""Camera axes of a photo that looks along x, z up."""
TILT = Rotation.from_euler("xyz", [35, -50, 70], degrees=True).as_matrix()
"""The model's axes, anyhow."""


def held(headings: F64, pitch: F64, roll: F64) -> F64:
    """Rotations of cameras by heading, pitch (down) and roll in degrees."""
    turned = Rotation.from_euler("ZYX", np.column_stack([headings, pitch, roll]), degrees=True).as_matrix()
    return TILT @ turned @ LEVEL


def error_deg(rotations: F64) -> float:
    return float(np.degrees(np.arccos(np.clip(up_of_photos(rotations) @ TILT[:, 2], -1, 1))))


@pytest.mark.parametrize("arc", [40, 90, 200, 360])
@pytest.mark.parametrize("pitch", [-30, 0, 25, 45])
def test_cameras_on_an_arc_that_are_pitched_alike(arc: float, pitch: float) -> None:
    random = np.random.default_rng(1)
    number = 60
    rotations = held(np.linspace(0, arc, number), np.full(number, pitch), random.normal(0, 1.5, number))
    assert error_deg(rotations) < 2


def test_some_photos_in_portrait_format_and_some_held_obliquely() -> None:
    random = np.random.default_rng(2)
    roll = random.normal(0, 1.5, 80)
    roll[::4] += 90
    roll[1::10] += 40
    assert error_deg(held(random.uniform(0, 360, 80), np.full(80, 20.0), roll)) < 2


def test_a_straight_drive_keeps_its_pitch_and_loses_its_roll() -> None:
    random = np.random.default_rng(3)
    rotations = held(random.normal(0, 1, 50), np.full(50, 3.0), random.normal(0, 1, 50))
    assert error_deg(rotations) == pytest.approx(3, abs=0.7)
