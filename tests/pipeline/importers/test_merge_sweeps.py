"""Points of a sweep that others hide from the photo beside it."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.pipeline.camera.models import pixel_angle
from scan2sim.pipeline.core.types import Camera
from scan2sim.pipeline.importers.merge_sweeps import OCCLUSION_BIN_RAD, _occluded

CAMERA = Camera("pinhole", 1200, 400, 700.0, 700.0, 599.5, 199.5)
ACROSS, DOWN = OCCLUSION_BIN_RAD / pixel_angle(CAMERA)  # pixels


@pytest.mark.parametrize(
    ("columns", "rows", "distance", "hidden"),
    [
        (0, 0, 20.0, True), (1, 0, 20.0, True), (-1, 0, 20.0, True), (2, 0, 20.0, False), (-2, 0, 20.0, False),
        (0, 1, 20.0, False), (0, -1, 20.0, False), (0, 0, 6.0, False), (1, 0, 4.0, False),
    ],
)  # fmt: skip
def test_what_is_nearer_hides_in_its_own_and_the_next_columns(
    columns: int, rows: int, distance: float, hidden: bool
) -> None:
    middle = (np.floor(np.array([600.0, 200.0]) / [ACROSS, DOWN]) + 0.5) * [ACROSS, DOWN] - 0.5
    uv = np.stack([middle, middle + [columns * ACROSS, rows * DOWN]])
    assert _occluded(uv, np.array([5.0, distance]), CAMERA).tolist() == [False, hidden]
