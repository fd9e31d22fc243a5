"""Counts of sweeps that see points or pass through them, on a drive past a wall with a temporary object."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.pipeline.core.types import F32, F64, Trajectory
from scan2sim.pipeline.lidar.sightings import sightings

SWEEPS, INTERVAL_S, START_S = 10, 0.1, 1_700_000_000.0
SPEED_MPS, WALL_Y, SCREEN_Y = 10.0, 15.0, 6.0
BOX = np.array([5.0, 10.0, 0.0])
"""Centre of a square of 1 m across the rays, before the wall."""


def scan(there: set[int], screen: bool = False) -> tuple[F32, F64, Trajectory]:
    """Returns, times and path of a scanner that drives along x and turns in each sweep.

    The square at `BOX` is there in the sweeps `there`; with `screen` a wall before it hides everything.
    """
    azimuth, elevation = (
        a.ravel() for a in np.meshgrid(np.radians(np.arange(30, 150, 0.2)), np.radians(np.arange(-4, 4, 0.4)))
    )
    ray = np.stack(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], axis=1
    )
    returns, times = [], []
    for k in range(SWEEPS):
        time = START_S + INTERVAL_S * (k + azimuth / (2 * np.pi))
        origin = np.zeros((len(ray), 3))
        origin[:, 0] = SPEED_MPS * (time - START_S)
        distance = (SCREEN_Y if screen else WALL_Y) / ray[:, 1]
        if k in there and not screen:
            to_box = BOX[1] / ray[:, 1]
            at = origin + to_box[:, None] * ray
            distance = np.where((np.abs(at - BOX)[:, [0, 2]] < 0.5).all(axis=1), to_box, distance)
        returns.append(origin + distance[:, None] * ray)
        times.append(time)
    pose_times = INTERVAL_S * np.arange(SWEEPS + 1).astype(np.float64)
    path = Trajectory(START_S + pose_times, np.column_stack([SPEED_MPS * pose_times, *np.zeros((2, len(pose_times)))]))
    return np.concatenate(returns).astype(np.float32), np.concatenate(times), path


@pytest.mark.parametrize(("there", "seen"), [({8, 9}, 2), ({0}, 1), (set(range(SWEEPS)), SWEEPS)])
def test_temporary_object_is_seen_by_its_sweeps_and_passed_by_the_others(there: set[int], seen: int) -> None:
    found = sightings(BOX[None].astype(np.float32), *scan(there))
    assert [int(count[0]) for count in found] == [seen, SWEEPS - seen]


def test_no_sweep_passes_through_a_wall() -> None:
    wall = np.array([[x, WALL_Y, 0.2] for x in (0.0, 4.0, 8.0)], np.float32)
    seen, passed = sightings(wall, *scan({3, 4}))
    assert (seen >= SWEEPS - 2).all() and not passed.any()


def test_occluded_object_is_neither_seen_nor_passed() -> None:
    seen, passed = sightings(BOX[None].astype(np.float32), *scan({8}, screen=True))
    assert not seen.any() and not passed.any()
