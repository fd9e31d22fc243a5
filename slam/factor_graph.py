"""Factor graph of bundle adjustment: cameras, 3D points, observations and further constraints (D3.2, section 4.1)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from scan2sim.pipeline.core.types import F64, I32, Bools


@dataclass(frozen=True)
class DistanceConstraint:
    """Relative distance constraint between two cameras, for example from GPS.

    Attributes:
        first, second: indices of the cameras.
        distance: metres.
        sigma: standard deviation, metres.
    """

    first: int
    second: int
    distance: float
    sigma: float


@dataclass(frozen=True)
class Factor:
    """User-defined constraint between cameras.

    Attributes:
        cameras: indices of the cameras.
        residual: function of their poses, (4, 4) camera to world each, and `measured`; returns the residual vector
            divided by its standard deviations. It must use operators and indexing only, so that it works with NumPy
            arrays and torch tensors.
        measured: last argument of `residual`.
    """

    cameras: tuple[int, ...]
    residual: Callable[..., Any]
    measured: F64


@dataclass(frozen=True)
class Graph:
    """A bundle adjustment problem.

    Attributes:
        poses: (C, 4, 4) camera to world.
        points: (P, 3) world.
        point_of, camera_of: (O,) point and camera of each observation; sorted by point.
        bearing: (O, 3) unit vectors of the observations, camera axes.
        fixed: (C,) whether a camera is fixed.
        sigma: standard deviation of a bearing, radians; scale of the Cauchy loss.
        distances: relative distance constraints.
        factors: other constraints.
        shared_jacobian: (O, S, 6) translation (m) and rotation (rad, about world axes) of an observation's camera per
            unit of each shared parameter: rolling shutter, lens offset.
        shared: (S,) shared parameters, and mean of their prior.
        shared_sigma: (S,) standard deviations of their prior.
    """

    poses: F64
    points: F64
    point_of: I32
    camera_of: I32
    bearing: F64
    fixed: Bools
    sigma: float
    distances: tuple[DistanceConstraint, ...] = ()
    factors: tuple[Factor, ...] = ()
    shared_jacobian: F64 = field(default_factory=lambda: np.zeros((0, 0, 6)))
    shared: F64 = field(default_factory=lambda: np.zeros(0))
    shared_sigma: F64 = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class Solution:
    """Solved variables of a graph: `poses` (C, 4, 4), `points` (P, 3), `shared` (S,)."""

    poses: F64
    points: F64
    shared: F64


def errors(graph: Graph, poses: F64, points: F64, shared: F64 | None = None) -> F64:
    """(O,) reprojection errors: angle between each observation and the direction of its point, radians."""
    R, t = poses[graph.camera_of, :3, :3], poses[graph.camera_of, :3, 3]
    if graph.shared_jacobian.shape[1] and shared is not None:
        from scan2sim.slam.geometry import exp_so3

        moved = np.einsum("osk,s->ok", graph.shared_jacobian, shared)
        t = t + moved[:, :3]
        R = exp_so3(moved[:, 3:]) @ R
    seen = np.einsum("oji,oj->oi", R, points[graph.point_of] - t)
    sine = np.linalg.norm(np.cross(seen, graph.bearing), axis=1)
    return np.arctan2(sine, np.einsum("ok,ok->o", seen, graph.bearing))
