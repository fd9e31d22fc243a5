"""Lists of doors, windows and stairs."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.pipeline.buildings.room_lists import openings_of, stairs_of
from scan2sim.pipeline.buildings.wall_lines import Run
from scan2sim.pipeline.buildings.wall_slabs import Wall


def test_openings_have_kind_size_and_axis() -> None:
    run = Run(np.array([0.0, 1.0]), 2.0, -6.0, 0.0, 0.05)  # along -x, at y = 2
    holes = np.array([[-2.0, -1.0, -1.0, 2.05], [-4.0, -3.0, 0.9, 2.1], [-7.0, -4.5, -1.0, 2.4]])
    door, window, passage = openings_of([Wall(run, 0.0, 2.6, holes, 2)], 1)
    assert (door.kind, window.kind, passage.kind) == ("door", "window", "door")
    assert door.position == pytest.approx([1.5, 2.0, 0.0]) and door.storey == 1
    assert (door.width, door.height, door.length) == pytest.approx((1.0, 2.05, 0.1))
    assert abs(door.axis @ [0, 1]) == 1
    assert window.position[2] == 0.9 and window.height == pytest.approx(1.2)
    assert passage.width == pytest.approx(1.5)  # within the wall


def test_wide_openings_are_passages() -> None:
    run = Run(np.array([1.0, 0.0]), 0.0, 0.0, 8.0, 0.05)
    (one,) = openings_of([Wall(run, 0.0, 2.6, np.array([[1.0, 5.0, -1.0, 2.4]]), 2)], 0)
    assert one.kind == "passage"


def test_flight_of_stairs_has_position_axis_and_size() -> None:
    rng = np.random.default_rng(0)
    along = rng.uniform(0, 2.7, 4000)
    z = 0.17 * np.floor(along / 0.27)
    xyz = np.column_stack([3 - along, rng.uniform(1, 2.2, 4000), z]).astype(np.float32)
    (one,) = stairs_of(xyz, 0, 0.05)
    assert one.kind == "stairs"
    assert one.axis == pytest.approx([-1, 0], abs=0.03)
    assert (one.width, one.height, one.length) == pytest.approx((1.2, 1.53, 2.7), abs=0.15)
    assert one.position[:2] == pytest.approx([3, 1.6], abs=0.15)
    assert list(stairs_of(xyz[:10], 0, 0.05)) == []
