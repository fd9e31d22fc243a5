"""Height of the ground at the origin of a world."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.step import Params, silent
from scan2sim.pipeline.core.types import Frame, Mesh
from scan2sim.pipeline.simulation import ground_origin
from scan2sim.pipeline.steps.origin import ORIGIN


def slope(x: float, y: float, code: int) -> Mesh:
    """A square of 10 m around (x, y) whose height is 1 + x / 10."""
    corners = np.array([(x + a, y + b, 1 + (x + a) / 10) for a in (-5, 5) for b in (-5, 5)], np.float32)
    faces = np.array([(0, 2, 1), (1, 2, 3)], np.int32)
    return Mesh(Frame("EPSG:32633", (500.0, 600.0, 30.0)), corners, faces, classification=np.full(2, code, np.uint8))


@pytest.mark.parametrize(
    ("x", "y", "code", "height"),
    [
        (0, 0, CODE["road"], 1.0),
        (2, 1, CODE["terrain"], 1.0),
        (15, 0, CODE["sidewalk"], 2.0),  # the nearest edge of the ground
        (0, -30, CODE["terrain"], 1.0),
        (0, 0, CODE["building"], None),
    ],
)
def test_origin_is_on_the_nearest_ground(tmp_path: Path, x: float, y: float, code: int, height: float | None) -> None:
    slope(x, y, code).save(tmp_path / "collision.npz")
    done = ORIGIN.run({"collision": tmp_path / "collision.npz"}, Params(), tmp_path, silent)
    assert done.metrics["above_m"] == (None if height is None else pytest.approx(height, abs=0.011))
    assert ground_origin.read(done.files) == pytest.approx((500, 600, 30 + (height or 0)), abs=0.011)
    assert ground_origin.read({}) is None
