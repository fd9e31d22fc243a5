"""Pose estimation: a frame's pose from the map points that it observes (motion-only bundle adjustment)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2sim.pipeline.core.types import F64, I64
from scan2sim.slam.factor_graph import Graph
from scan2sim.slam.geometry import angles
from scan2sim.slam.mapping.local_map import LocalMap
from scan2sim.slam.solvers import lm
from scan2sim.slam.trackers import Tracks

POINTS_MIN = 8
"""Known points needed for a pose, and inliers needed for its covariance."""
OUTLIER_GATES = 3
"""Multiple of the map's inlier gate beyond which an observation is an outlier."""


@dataclass(frozen=True)
class PoseEstimate:
    """Estimated pose of a frame.

    Attributes:
        pose: (4, 4) camera to world; the initial guess if too few points are known.
        known: number of observed points that the map knows.
        inliers: number of these that fit the pose.
        outliers: (N,) ids of those that contradict it.
        covariance: (6, 6) of the pose relative to the points, metres and radians about world axes; None: unknown.
    """

    pose: F64
    known: int
    inliers: int
    outliers: I64
    covariance: F64 | None = None


def estimate_pose(points: LocalMap, tracks: Tracks, guess: F64, velocity: F64) -> PoseEstimate:
    """Pose by the known points among a frame's tracks.

    Args:
        points: the map.
        tracks: the frame's tracks.
        guess: (4, 4) initial pose, camera to world.
        velocity: (6,) metres and radians per second, in the camera's axes.
    """
    rows, known = points.landmarks.find(tracks.ids)
    n = int(known.sum())
    if n < POINTS_MIN:
        return PoseEstimate(guess, n, 0, np.zeros(0, np.int64))
    xyz, bearing, camera_of = points.landmarks.xyz[rows[known]], tracks.bearing[known], np.zeros(n, np.int32)
    graph = Graph(
        guess[None], xyz, np.arange(n, dtype=np.int32), camera_of, bearing, np.zeros(1, bool), points.sigma,
        shared_jacobian=points.shared_jacobian(guess[None], velocity[None], camera_of, bearing), shared=points.shared,
        shared_sigma=np.full(len(points.shared), 1e-9),
    )  # fmt: skip
    pose = points.solver.solve(graph, points=False).poses[0]
    error = angles(pose, xyz, bearing)
    inlier = error < points.gate
    covariance = _covariance(pose, xyz[inlier], bearing[inlier], error[inlier]) if inlier.sum() >= POINTS_MIN else None
    outliers = tracks.ids[known][error > OUTLIER_GATES * points.gate]
    return PoseEstimate(pose, n, int(inlier.sum()), outliers, covariance)


def _covariance(pose: F64, xyz: F64, bearing: F64, error: F64) -> F64:
    """(6, 6) covariance of a pose (4, 4) from points (N, 3), their bearings (N, 3) and angular errors (N,), radians."""
    n = len(xyz)
    graph = Graph(pose[None], xyz, np.arange(n, dtype=np.int32), np.zeros(n, np.int32), bearing, np.zeros(1, bool), 1.0)
    noise = float((error**2).sum()) / (2 * n - 6)
    return np.asarray(noise * np.linalg.pinv(lm.information(graph, points=False), hermitian=True), np.float64)
