"""Missing frames with consecutive times: wrong poses after the gap are marked unsure."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.pipeline.core.types import Trajectory
from scan2sim.slam.odometry.odometry import Odometry, OdometryParams
from tests.slam.conftest import PERSPECTIVE


@pytest.mark.parametrize(
    "rows",
    [list(range(40)), [*range(10), *range(25, 40)], list(range(0, 40, 5))],
    ids=("whole", "fifteen cut out", "every fifth"),
)
def test_wrong_poses_after_missing_frames_are_marked_unsure(
    turn: tuple[Trajectory, np.ndarray], rows: list[int]
) -> None:
    truth, greys = turn
    odometry = Odometry(PERSPECTIVE, OdometryParams())
    for at, row in enumerate(rows):  # times as if no frames were missing
        odometry.add(at / 10, greys[row])
    found = np.stack([odometry.pose_of(placed)[:3, 3] for placed in odometry.placed])
    there = truth.positions[rows] - truth.positions[0]
    second = round(10 * odometry.map.keyframes[1].time)  # its distance is the unit of length
    unit = np.linalg.norm(there[second]) / max(float(np.linalg.norm(found[second])), 1e-9)
    off = np.linalg.norm(unit * found @ odometry_axes(truth).T - there, axis=1)
    unsure = np.array([placed.unsure for placed in odometry.placed])
    assert unsure[off > 1.0].all(), np.round(off, 1)
    assert (off > 1.0).any() == unsure.any() == (len(rows) < 40), np.round(off, 1)


def odometry_axes(truth: Trajectory) -> np.ndarray:
    """(3, 3) axes of the odometry's world, those of the first camera."""
    assert truth.rotations is not None
    return np.asarray(truth.rotations[0])
