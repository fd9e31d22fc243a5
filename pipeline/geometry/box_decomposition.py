"""Upright things as boxes: what physics engines take that know no concave meshes.

A surface is sampled, its samples fall into square columns over the ground plan; neighbours that reach from
and to about the same height are one box.
"""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.types import F32, F64, I64

STEP = 0.25
"""Metres to which columns' ends are rounded, downwards and upwards."""


def boxes(corners: F32, cell: float) -> tuple[F64, F64]:
    """Lowest and highest corners (B, 3) each of boxes that hold all of the triangles (F, 3, 3), local metres.

    Args:
        corners: of the triangles.
        cell: metres a side of a column: how far a box may stick out.
    """
    points = samples(corners, cell / 2)
    if not len(points):
        return np.zeros((0, 3)), np.zeros((0, 3))
    place = np.floor(points[:, :2] / cell).astype(np.int64)
    cells, of = np.unique(place, axis=0, return_inverse=True)
    low, high = np.full(len(cells), np.inf), np.full(len(cells), -np.inf)
    np.minimum.at(low, of.ravel(), points[:, 2])
    np.maximum.at(high, of.ravel(), points[:, 2])
    bottom = np.floor(low / STEP)
    reach = np.column_stack([bottom, np.maximum(np.ceil(high / STEP), bottom + 1)]).astype(np.int64)
    runs = _merged(np.column_stack([cells, cells, reach]), 0)
    whole = _merged(runs, 1)
    size = np.array([cell, cell])
    return (
        np.column_stack([whole[:, :2] * size, whole[:, 4] * STEP]),
        np.column_stack([(whole[:, 2:4] + 1) * size, whole[:, 5] * STEP]),
    )


def samples(corners: F32, spacing: float) -> F64:
    """(N, 3) points of triangles (F, 3, 3), no further than `spacing` from the next, corners among them."""
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    pieces = np.maximum(1, np.ceil(edges / spacing)).astype(int)
    found = [np.zeros((0, 3))]
    for n in np.unique(pieces):
        i, j = np.nonzero(np.add.outer(np.arange(n + 1), np.arange(n + 1)) <= n)
        weight = np.column_stack([i, j, n - i - j]) / n
        found.append((weight @ corners[pieces == n].astype(np.float64)).reshape(-1, 3))
    return np.concatenate(found)


def _merged(parts: I64, axis: int) -> I64:
    """Blocks (x0, y0, x1, y1, low, high), in cells, with those joined that follow each other along an axis."""
    across = [k for k in (0, 1) if k != axis]
    same = [*across, *(k + 2 for k in across), 4, 5]
    parts = parts[np.lexsort([parts[:, axis], *(parts[:, k] for k in same)])]
    follows = (parts[1:, same] == parts[:-1, same]).all(axis=1) & (parts[1:, axis] == parts[:-1, axis + 2] + 1)
    first = np.flatnonzero(np.concatenate([[True], ~follows]))
    last = np.concatenate([first[1:], [len(parts)]]) - 1
    joined = parts[first].copy()
    joined[:, axis + 2] = parts[last, axis + 2]
    return joined
