"""Locate: where a frame is, by the points of the map that it sees."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2sim.pipeline.core.types import F64, I64
from scan2sim.slam import solvers
from scan2sim.slam.geometry import angles
from scan2sim.slam.mapping.factor_graph import Graph
from scan2sim.slam.mapping.local_map import LocalMap
from scan2sim.slam.solvers import lm
from scan2sim.slam.trackers import Tracks

FEWEST = 8
"""Points that must be known."""


@dataclass(frozen=True)
class Located:
    """Where a frame is.

    Attributes:
        pose: (4, 4) camera to world; the guess, where too few points are known.
        known: how many of the points that it sees are known.
        agree: how many of these agree with the pose.
        wrong: (N,) ids of those that contradict it.
        covariance: (6, 6) of the pose against the points, metres and radians about world axes; None: unknown.
    """

    pose: F64
    known: int
    agree: int
    wrong: I64
    covariance: F64 | None = None


def locate(points: LocalMap, tracks: Tracks, guess: F64, velocity: F64) -> Located:
    """The pose by the known points among a frame's tracks.

    Args:
        points: the map.
        tracks: what the frame sees.
        guess: (4, 4) about where it is.
        velocity: (6,) metres and radians a second, in the camera's axes.
    """
    rows, known = points.landmarks.find(tracks.ids)
    n = int(known.sum())
    if n < FEWEST:
        return Located(guess, n, 0, np.zeros(0, np.int64))
    xyz, bearing, one = points.landmarks.xyz[rows[known]], tracks.bearing[known], np.zeros(n, np.int32)
    graph = Graph(
        guess[None], xyz, np.arange(n, dtype=np.int32), one, bearing, np.zeros(1, bool), points.sigma,
        bend=points.bend(guess[None], velocity[None], one, bearing), shared=points.shared,
        shared_sigma=np.full(len(points.shared), 1e-9),
    )  # fmt: skip
    pose = solvers.named(points.backend).solve(graph, points=False).poses[0]
    error = angles(pose, xyz, bearing)
    good = error < points.gate
    covariance = _covariance(pose, xyz[good], bearing[good], error[good]) if good.sum() >= FEWEST else None
    return Located(pose, n, int(good.sum()), tracks.ids[known][error > 3 * points.gate], covariance)


def _covariance(pose: F64, xyz: F64, bearing: F64, error: F64) -> F64:
    """Of a pose (4, 4) by points (N, 3), their bearings (N, 3) and the errors of these (N,), radians."""
    n = len(xyz)
    graph = Graph(pose[None], xyz, np.arange(n, dtype=np.int32), np.zeros(n, np.int32), bearing, np.zeros(1, bool), 1.0)
    noise = float((error**2).sum()) / (2 * n - 6)
    return np.asarray(noise * np.linalg.pinv(lm.information(graph, points=False), hermitian=True), np.float64)
