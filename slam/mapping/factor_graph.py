"""The graph: explicit 3D points, cameras, what each camera sees of them, and what else is known (D3.2, section 4.1)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from scan2sim.pipeline.core.types import F64, I32, Bools


@dataclass(frozen=True)
class Chord:
    """The distance of two cameras is known: from GPS, say.

    Attributes:
        first, second: cameras.
        distance: metres.
        sigma: metres.
    """

    first: int
    second: int
    distance: float
    sigma: float


@dataclass(frozen=True)
class Factor:
    """A constraint of your own between cameras.

    Attributes:
        cameras: which.
        residual: of their poses (4, 4) each, camera to world, and `measured`, to a vector that should be zero, already
            divided by its standard deviations. Written with operators and indexing alone, it serves arrays and
            tensors alike.
        measured: what it is given besides.
    """

    cameras: tuple[int, ...]
    residual: Callable[..., Any]
    measured: F64


@dataclass(frozen=True)
class Graph:
    """What is to be solved.

    Attributes:
        poses: (C, 4, 4) camera to world.
        points: (P, 3) world.
        point_of, camera_of: (O,) what each observation sees, and which camera does; sorted by point.
        bearing: (O, 3) unit, camera axes.
        fixed: (C,) cameras that stay.
        sigma: radians, of a bearing: errors much above it count little (Cauchy).
        chords: known distances.
        factors: other constraints.
        bend: (O, S, 6) how a unit of each shared parameter moves (m) and turns (rad, about world axes) the camera of an
            observation: rolling shutter, lens offset.
        shared: (S,) the shared parameters.
        shared_sigma: (S,) how far they may well be from what is believed.
        believed: (S,) what that is; None: as they are.
    """

    poses: F64
    points: F64
    point_of: I32
    camera_of: I32
    bearing: F64
    fixed: Bools
    sigma: float
    chords: tuple[Chord, ...] = ()
    factors: tuple[Factor, ...] = ()
    bend: F64 = field(default_factory=lambda: np.zeros((0, 0, 6)))
    shared: F64 = field(default_factory=lambda: np.zeros(0))
    shared_sigma: F64 = field(default_factory=lambda: np.zeros(0))
    believed: F64 | None = None


@dataclass(frozen=True)
class Solution:
    """What came out: `poses` (C, 4, 4), `points` (P, 3), `shared` (S,)."""

    poses: F64
    points: F64
    shared: F64


def errors(graph: Graph, poses: F64, points: F64, shared: F64 | None = None) -> F64:
    """(O,) radians between every observation and the direction of its point."""
    R, t = poses[graph.camera_of, :3, :3], poses[graph.camera_of, :3, 3]
    if graph.bend.shape[1] and shared is not None:
        from scan2sim.slam.geometry import exp_so3

        moved = np.einsum("osk,s->ok", graph.bend, shared)
        t = t + moved[:, :3]
        R = exp_so3(moved[:, 3:]) @ R
    seen = np.einsum("oji,oj->oi", R, points[graph.point_of] - t)
    sine = np.linalg.norm(np.cross(seen, graph.bearing), axis=1)
    return np.arctan2(sine, np.einsum("ok,ok->o", seen, graph.bearing))
