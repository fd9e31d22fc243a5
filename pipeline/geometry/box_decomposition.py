"""Box decomposition of meshes, for physics engines without concave collision meshes.

A surface is sampled, and the samples are sorted into square columns in plan view; adjacent columns with about the same
bottom and top are merged into one box.
"""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.types import F32, F64, I64

HEIGHT_STEP_M = 0.25
"""Bottoms and tops of columns are rounded down and up to multiples of this by default."""
ROUNDING_TOLERANCE_M = 1e-3
"""Heights that exceed a multiple by less, such as by rounding errors of samples, are rounded to it."""


def boxes(corners: F32, cell: float, height_step: float = HEIGHT_STEP_M) -> tuple[F64, F64]:
    """Lowest and highest corners, (B, 3) each, of boxes that contain the triangles (F, 3, 3) to 1 mm, local metres.

    Args:
        corners: corners of the triangles.
        cell: side of a column in metres: the largest distance by which a box may extend beyond the surface.
        height_step: bottoms and tops are rounded down and up to multiples of it, metres.
    """
    points = samples(corners, cell / 2)
    if not len(points):
        return np.zeros((0, 3)), np.zeros((0, 3))
    column_index = np.floor(points[:, :2] / cell).astype(np.int64)
    cells, column_of = np.unique(column_index, axis=0, return_inverse=True)
    low, high = np.full(len(cells), np.inf), np.full(len(cells), -np.inf)
    np.minimum.at(low, column_of.ravel(), points[:, 2])
    np.maximum.at(high, column_of.ravel(), points[:, 2])
    bottom = np.floor((low + ROUNDING_TOLERANCE_M) / height_step)
    top = np.maximum(np.ceil((high - ROUNDING_TOLERANCE_M) / height_step), bottom + 1)
    height_range = np.column_stack([bottom, top]).astype(np.int64)
    runs = _merge(np.column_stack([cells, cells, height_range]), 0)
    merged = _merge(runs, 1)
    size = np.array([cell, cell])
    return (
        np.column_stack([merged[:, :2] * size, merged[:, 4] * height_step]),
        np.column_stack([(merged[:, 2:4] + 1) * size, merged[:, 5] * height_step]),
    )


def samples(corners: F32, spacing: float) -> F64:
    """Points (N, 3) on triangles (F, 3, 3), at most `spacing` apart, including the corners."""
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    pieces = np.maximum(1, np.ceil(edges / spacing)).astype(int)
    found = [np.zeros((0, 3))]
    for n in np.unique(pieces):
        i, j = np.nonzero(np.add.outer(np.arange(n + 1), np.arange(n + 1)) <= n)
        weight = np.column_stack([i, j, n - i - j]) / n
        found.append((weight @ corners[pieces == n].astype(np.float64)).reshape(-1, 3))
    return np.concatenate(found)


def _merge(parts: I64, axis: int) -> I64:
    """Merge blocks (x0, y0, x1, y1, low, high), in cells, that are adjacent along an axis."""
    across = [k for k in (0, 1) if k != axis]
    same = [*across, *(k + 2 for k in across), 4, 5]
    parts = parts[np.lexsort([parts[:, axis], *(parts[:, k] for k in same)])]
    follows = (parts[1:, same] == parts[:-1, same]).all(axis=1) & (parts[1:, axis] == parts[:-1, axis + 2] + 1)
    first = np.flatnonzero(np.concatenate([[True], ~follows]))
    last = np.concatenate([first[1:], [len(parts)]]) - 1
    joined = parts[first].copy()
    joined[:, axis + 2] = parts[last, axis + 2]
    return joined
