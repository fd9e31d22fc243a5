"""Alignment: turns odometry's poses into a trajectory that is upright, scaled by GPS and georeferenced."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.types import F64, Frame, GpsTrack, Trajectory
from scan2sim.slam.geometry import exp_so3
from scan2sim.slam.global_map.covariance import covariances, transformed
from scan2sim.slam.global_map.map_file import MapCheckpoint
from scan2sim.slam.global_map.sparse_model import Alignment
from scan2sim.slam.trajectory import scale


def aligned_trajectory(
    checkpoint: MapCheckpoint, gps: GpsTrack | None, *, georeference: bool = True
) -> tuple[Trajectory, Alignment]:
    """Trajectory, camera to a z-up world, and the transform to it.

    Args:
        checkpoint: odometry's result.
        gps: GPS track in the frames' times, from which scale and position are determined. Without it, the origin is
            the first camera, and the x axis its viewing direction.
        georeference: place the trajectory by GPS; otherwise GPS determines only the scale.
    """
    placed = checkpoint.placed
    times = np.array([p.time for p in placed])
    unsure = np.array([p.unsure for p in placed])
    poses = np.stack([checkpoint.pose_of(p) for p in placed])
    R = upright(poses)
    positions, rotations = poses[:, :3, 3] @ R.T, R @ poses[:, :3, :3]
    factor, frame = np.ones(len(times) - 1), Frame()
    if gps is not None:
        equirectangular = checkpoint.camera.model == "equirectangular"
        drift = scale.DRIFT_360 if equirectangular else scale.DRIFT_PERSPECTIVE
        factor = scale.factors(times, positions, unsure, gps, drift)
        positions = scale.apply(positions, factor)
        if georeference:
            turn, shift = align_to_gps(positions, gps.at(times))
            R, positions, rotations = turn @ R, positions @ turn.T + shift, turn @ rotations
            frame = gps.frame
    unit = float(np.median(factor)) if len(factor) else 1.0
    covariance = transformed(covariances(checkpoint, gps, unit, placed=gps is not None and georeference), R, unit)
    trajectory = Trajectory(times, positions, rotations, unsure, covariance)
    return trajectory, Alignment(R, factor, frame)


def upright(poses: F64) -> F64:
    """(3, 3) rotation to a z-up world; assumes that cameras are upright on average. x is the first view direction."""
    down = poses[:, :3, 1].mean(axis=0)
    up = -down / np.linalg.norm(down)
    ahead = poses[0, :3, 2] - up * (poses[0, :3, 2] @ up)
    ahead /= np.linalg.norm(ahead)
    return np.stack([ahead, np.cross(up, ahead), up])


def align_to_gps(positions: F64, gps_positions: F64) -> tuple[F64, F64]:
    """Robust rigid alignment: rotation about z (3, 3) and shift (3,) from positions to GPS positions.

    Args:
        positions: (T, 3) metres.
        gps_positions: (T, 3) metres, NaN where unknown.
    """
    known = np.isfinite(gps_positions[:, 0])
    if known.sum() < 2:
        return np.eye(3), np.zeros(3)
    a, b = positions[known], gps_positions[known]
    w = np.ones(len(a))
    for _ in range(10):
        ma, mb = np.average(a, axis=0, weights=w), np.average(b, axis=0, weights=w)
        p, q = a - ma, b - mb
        angle = np.arctan2(
            (w * (p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0])).sum(), (w * (p[:, :2] * q[:, :2]).sum(axis=1)).sum()
        )
        turn = exp_so3([0.0, 0.0, angle])
        shift = mb - turn @ ma
        error = np.linalg.norm((a @ turn.T + shift - b)[:, :2], axis=1)
        w = 1 / (1 + (error / 3.0) ** 2)
    return turn, shift
