"""Boxes of vehicles that were scanned from one side only."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.segmentation.vehicle_boxes import Rectangle, _with_full_width

WEST, EAST = np.array([[-5.0, 0, 2], [-5.0, 20, 2]]), np.array([[9.0, 0, 2], [9.0, 20, 2]])


@pytest.mark.parametrize("heading", [np.pi / 2, -np.pi / 2])
@pytest.mark.parametrize(("path", "x"), [(WEST, 2.55), (EAST, 1.45)])
def test_box_of_one_side_is_widened_away_from_the_scanner(path: np.ndarray, x: float, heading: float) -> None:
    side = Rectangle(2.0, 10.0, heading, 4.2, 0.5)  # from x = 1.75 to 2.25, along y
    whole = _with_full_width(side, path)
    assert (whole.length, whole.width, whole.heading) == (4.2, 1.6, heading)
    assert (whole.x, whole.y) == pytest.approx((x, 10.0))


def test_box_of_full_width_is_unchanged() -> None:
    box = Rectangle(2.0, 10.0, 0.3, 4.2, 1.5)
    assert _with_full_width(box, WEST) == box
