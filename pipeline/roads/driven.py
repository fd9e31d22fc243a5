"""Driven path: approximate course of roads, from the path of the recording vehicle, each road only once."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.types import F64, Bools

STEP_M = 1.0
"""Spacing of the points of a way."""
SAME_ROAD_DISTANCE_M = 8.0
"""Parallel ways closer than this are on the same road."""
MIN_LOOP_M = 20.0
"""Distance along a way after which it may return in the same direction; it may reverse at any point."""
PARALLEL_COS = 0.85
"""Smallest cosine between the directions of parallel ways."""
MIN_LENGTH_M = 2.0
"""Minimum length of a way; it may continue in the next tile."""
MAX_LENGTH_M = 1000.0
"""Maximum length of a way: longer roads are split, as the cost of fitting grows with the square of the length."""


def ways(positions: F64, on: Bools) -> list[F64]:
    """Polylines (M, 2) with points `STEP_M` apart along the roads that were driven on.

    Args:
        positions: (N, 2 or 3) positions of the vehicle, in order.
        on: (N,) bool, True if there is road below.
    """
    found: list[F64] = []
    for piece in _pieces(positions[:, :2], on):
        way = _resample(piece)
        for part in _pieces(way, _not_driven_before(way, found)):
            pieces = np.array_split(part, int(np.ceil(length(part) / MAX_LENGTH_M)))
            found += [piece for piece in pieces if length(piece) >= MIN_LENGTH_M]
    return found


def _pieces(points: F64, held: Bools) -> list[F64]:
    """Runs of consecutive points selected by `held`."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], held, [False]]).astype(int)))
    return [points[a:b] for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a > 1]


def length(points: F64) -> float:
    """Length of a polyline (N, 2), metres."""
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def _resample(points: F64) -> F64:
    """Points (M, 2) evenly spaced along a polyline; stops of the vehicle are removed."""
    kept = [0]
    for i in range(1, len(points)):
        if np.linalg.norm(points[i] - points[kept[-1]]) >= STEP_M / 2:
            kept.append(i)
    points = points[kept]
    chainage = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    even = np.linspace(0, chainage[-1], max(2, round(chainage[-1] / STEP_M) + 1))
    return np.column_stack([np.interp(even, chainage, column) for column in points.T])


def _not_driven_before(way: F64, earlier: list[F64]) -> Bools:
    """(M,) bool, False where the road was driven before, on this way or an earlier one."""
    from scipy.spatial import cKDTree

    direction = np.gradient(way, axis=0)
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-9)
    first = np.ones(len(way), bool)
    others = [(cKDTree(other), np.gradient(other, axis=0)) for other in earlier]
    for i, point in enumerate(way):
        near = np.flatnonzero(first[:i] & (np.linalg.norm(way[:i] - point, axis=1) < SAME_ROAD_DISTANCE_M))
        cosine = direction[near] @ direction[i]
        driven = bool((np.where(i - near > MIN_LOOP_M / STEP_M, np.abs(cosine), -cosine) > PARALLEL_COS).any())
        for tree, heading in others:
            distance, k = tree.query(point)
            unit = heading[k] / max(float(np.linalg.norm(heading[k])), 1e-9)
            driven |= bool(distance < SAME_ROAD_DISTANCE_M and abs(unit @ direction[i]) > PARALLEL_COS)
        first[i] = not driven
    return first


def extend(way: F64, beyond: float) -> F64:
    """Extend a way linearly at both ends."""
    first, last = way[0] - way[min(5, len(way) - 1)], way[-1] - way[-min(6, len(way))]
    out = [end + beyond * step / np.linalg.norm(step) for end, step in ((way[0], first), (way[-1], last))]
    return np.concatenate([out[:1], way, out[1:]])
