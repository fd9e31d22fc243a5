"""Rolling shutter and lens offset: estimated from bearings alone, and the accuracy with and without estimation."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from scan2sim.pipeline.core.types import F64
from scan2sim.slam.geometry import log_so3
from tests.fakes.slam_drive import Follower, ate, drive, gps_of, run, scatter

READOUT, OFFSET = 0.03, 0.04
"""Seconds from the first row to the last; metres from the camera's place to either lens."""


class RollingShutterFollower(Follower):
    """Sees each point through the lens that faces it, at the time when its row is read."""

    def __init__(self, poses: F64, readout: float, offset: float, **more: Any) -> None:
        super().__init__(poses, scatter(poses, 8000), **more)
        self.readout, self.offset = readout, offset

    def _seen(self, points: F64) -> tuple[F64, npt.NDArray[np.bool_]]:
        poses, i = self.poses, min(self._frame, len(self.poses) - 2)
        R, rate = poses[self._frame, :3, :3], (poses[i + 1, :3, 3] - poses[i, :3, 3]) / 0.1
        turning = log_so3(poses[i, :3, :3].T @ poses[i + 1, :3, :3]) / 0.1
        ideal, seen = super()._seen(points)
        noise, bearing = ideal - _unit((points - poses[self._frame, :3, 3]) @ R), ideal
        for _ in range(2):  # row and lens depend on the image position: iterate
            late = (np.arcsin(np.clip(bearing[:, 1:2], -1, 1)) / np.pi) * self.readout
            local = (points - poses[self._frame, :3, 3] - late * rate) @ R
            local = local - late * np.cross(turning, local)
            local[:, 2] -= self.offset * np.sign(bearing[:, 2])
            bearing = _unit(local)
        return _unit(bearing + noise), seen


def _unit(vectors: F64) -> F64:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@pytest.mark.parametrize(("readout", "offset"), [(READOUT, OFFSET), (0.0, 0.0)])
def test_readout_time_and_lens_offset_are_estimated(readout: float, offset: float) -> None:
    times, poses = drive(12, speed=12, turn=0.1)
    odometry = run(
        times,
        RollingShutterFollower(poses, readout, offset),
        gps=gps_of(times, poses),
        rolling_shutter=True,
        lens_offset=True,
    )
    assert odometry.map.names == ("readout", "lens_offset")
    assert odometry.map.shared[0] == pytest.approx(readout, abs=0.001)
    assert odometry.map.shared[1] == pytest.approx(offset, abs=0.001)


def test_estimating_rolling_shutter_does_not_reduce_accuracy() -> None:
    times, poses = drive(12, speed=12, turn=0.1)

    def error(**wanted: Any) -> float:
        odometry = run(times, RollingShutterFollower(poses, READOUT, OFFSET), gps=gps_of(times, poses), **wanted)
        return ate(np.stack([odometry.pose_of(p)[:3, 3] for p in odometry.placed]), poses[:, :3, 3])

    alone, both = error(), error(rolling_shutter=True, lens_offset=True)
    assert both < 0.2 * alone
