"""Overlaps of boxes in plan, by the separating axis theorem."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.tracking.tracks import Track, footprint


def depth(first: F64, second: F64) -> float:
    """How far two rectangles, each given by its corners (4, 2) in order, overlap in metres; 0 or less: not at all."""
    edges = np.concatenate([np.diff(corners[:3], axis=0) for corners in (first, second)])
    normals = np.column_stack([-edges[:, 1], edges[:, 0]]) / np.maximum(np.hypot(*edges.T), 1e-9)[:, None]
    a, b = first @ normals.T, second @ normals.T
    return float(np.minimum(a.max(axis=0) - b.min(axis=0), b.max(axis=0) - a.min(axis=0)).min())


def deepest(first: Track, second: Track) -> float:
    """Deepest overlap in metres of two tracks at the times of either, while both are there; 0 or less: none.

    Parked vehicles are there all the time.
    """
    moving = [track for track in (first, second) if track.moving]
    times = np.unique(np.concatenate([track.times for track in moving])) if moving else first.times[:1]
    for track in moving:
        times = times[(times >= track.times[0]) & (times <= track.times[-1])]
    deep = -np.inf
    for a, b in zip(first.at(times), second.at(times), strict=True):
        if np.hypot(*(a[:2] - b[:2])) < np.hypot(*first.size[:2]) / 2 + np.hypot(*second.size[:2]) / 2:
            deep = max(deep, depth(footprint(first.size, a), footprint(second.size, b)))
    return float(deep)
