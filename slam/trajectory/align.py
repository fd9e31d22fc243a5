"""Finish: what odometry placed becomes a trajectory: upright, in GPS's scale, where GPS says."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2sim.pipeline.core.types import F64, I64, Frame, GpsTrack, Trajectory
from scan2sim.slam.geometry import exp_so3
from scan2sim.slam.mapping.covariance import covariances, moved
from scan2sim.slam.mapping.map_file import Mapped
from scan2sim.slam.trajectory import scale


@dataclass(frozen=True)
class Placing:
    """How the camera's own world becomes that of the trajectory.

    Attributes:
        R: (3, 3) rotation, then
        shift: (3,) metres.
        factor: (T - 1,) what every step's length is multiplied by.
        frame: of the result.
    """

    R: F64
    shift: F64
    factor: F64
    frame: Frame

    def points(self, xyz: F64, at: I64, before: F64, after: Trajectory) -> F64:
        """Points (P, 3) of the camera's world, carried along with the poses `at` (P,) which they were seen from.

        `before` (T, 3) are the positions in the camera's world, `after` the finished trajectory.
        """
        steps = np.append(self.factor, self.factor[-1:] if len(self.factor) else [1.0])
        return (xyz - before[at]) * steps[at, None] @ self.R.T + after.positions[at]


def finish(mapped: Mapped, gps: GpsTrack | None, *, georeference: bool = True) -> tuple[Trajectory, Placing]:
    """The trajectory, camera to a z-up world; `gps` in the frames' times ties its scale, and places it.

    Without GPS, the world begins at the first camera, its x axis along that camera's view.
    """
    placed = mapped.placed
    times = np.array([p.time for p in placed])
    unsure = np.array([p.unsure for p in placed])
    poses = np.stack([mapped.pose_of(p) for p in placed])
    R = upright(poses)
    positions, rotations = poses[:, :3, 3] @ R.T, R @ poses[:, :3, :3]
    factor, frame = np.ones(len(times) - 1), Frame()
    if gps is not None:
        drifting = scale.AROUND if mapped.camera.model == "equirectangular" else scale.AHEAD
        factor = scale.factors(times, positions, unsure, gps, drifting)
        positions = scale.apply(positions, factor)
        if georeference:
            turn, shift = place(positions, gps.at(times))
            R, positions, rotations = turn @ R, positions @ turn.T + shift, turn @ rotations
            frame = gps.frame
    unit = float(np.median(factor)) if len(factor) else 1.0
    covariance = moved(covariances(mapped, gps, unit, placed=gps is not None and georeference), R, unit)
    trajectory = Trajectory(times, positions, rotations, unsure, covariance)
    return trajectory, Placing(R, positions[0] - poses[0, :3, 3] @ R.T, factor, frame)


def upright(poses: F64) -> F64:
    """(3, 3) rotation to a z-up world whose x axis is the first view's direction: cameras stand upright on average."""
    down = poses[:, :3, 1].mean(axis=0)
    up = -down / np.linalg.norm(down)
    ahead = poses[0, :3, 2] - up * (poses[0, :3, 2] @ up)
    ahead /= np.linalg.norm(ahead)
    return np.stack([ahead, np.cross(up, ahead), up])


def place(positions: F64, there: F64) -> tuple[F64, F64]:
    """Turn about z (3, 3) and shift (3,) that bring positions (T, 3) to GPS's (T, 3; NaN where unknown), robustly."""
    known = np.isfinite(there[:, 0])
    if known.sum() < 2:
        return np.eye(3), np.zeros(3)
    a, b = positions[known], there[known]
    w = np.ones(len(a))
    for _ in range(10):
        ma, mb = np.average(a, axis=0, weights=w), np.average(b, axis=0, weights=w)
        p, q = a - ma, b - mb
        angle = np.arctan2(
            (w * (p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0])).sum(), (w * (p[:, :2] * q[:, :2]).sum(axis=1)).sum()
        )
        turn = exp_so3([0.0, 0.0, angle])
        shift = mb - turn @ ma
        off = np.linalg.norm((a @ turn.T + shift - b)[:, :2], axis=1)
        w = 1 / (1 + (off / 3.0) ** 2)
    return turn, shift
