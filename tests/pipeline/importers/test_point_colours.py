"""Colours of points: occlusion in photos, and colours of points that are in no photo."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.pipeline.camera.models import pixel_angle
from scan2sim.pipeline.core.types import UNCOLOURED, Camera
from scan2sim.pipeline.importers.point_colours import OCCLUSION_BIN_RAD, _occluded, fill_colours

CAMERA = Camera("pinhole", 1200, 400, 700.0, 700.0, 599.5, 199.5)
ACROSS, DOWN = OCCLUSION_BIN_RAD / pixel_angle(CAMERA)  # pixels


@pytest.mark.parametrize(
    ("columns", "rows", "distance", "hidden"),
    [
        (0, 0, 20.0, True), (1, 0, 20.0, True), (-1, 0, 20.0, True), (2, 0, 20.0, False), (-2, 0, 20.0, False),
        (0, 1, 20.0, False), (0, -1, 20.0, False), (0, 0, 6.0, False), (1, 0, 4.0, False),
    ],
)  # fmt: skip
def test_nearer_points_occlude_their_own_and_adjacent_columns(
    columns: int, rows: int, distance: float, hidden: bool
) -> None:
    middle = (np.floor(np.array([600.0, 200.0]) / [ACROSS, DOWN]) + 0.5) * [ACROSS, DOWN] - 0.5
    uv = np.stack([middle, middle + [columns * ACROSS, rows * DOWN]])
    assert _occluded(uv, np.array([5.0, distance]), CAMERA).tolist() == [False, hidden]


def test_unseen_points_get_the_colour_of_the_nearest_seen_one_nearby() -> None:
    xyz = np.array([[0, 0, 0], [10, 0, 0], [0.15, 0, 0], [10.1, 0, 0], [5, 0, 0]], np.float32)
    rgb = np.array([[1, 2, 3], [7, 8, 9], [0, 0, 0], [0, 0, 0], [0, 0, 0]], np.uint8)
    out = fill_colours(xyz, rgb, np.array([True, True, False, False, False]), np.ones(5, np.float32))
    assert out.tolist() == [[1, 2, 3], [7, 8, 9], [1, 2, 3], [7, 8, 9], [UNCOLOURED] * 3]
