"""Outliers of a map: far returns that inflate its extent, isolated points, and reflections below the floor."""

from __future__ import annotations

import math

import numpy as np

from scan2sim.pipeline.core.types import F32, I64, Bools
from scan2sim.pipeline.geometry.sorting import first_of_each, stable_argsort

FAR_CELL_SPACINGS = 12.0
"""Edge of the cells whose connected groups are counted, in point spacings."""
MIN_FAR_CELL_M = 0.5
MIN_GROUP_SHARE = 0.01
"""Share of all points from which a separate group is a part of the map (another room), not outliers."""
ISOLATED_NEIGHBOURS = 3
ISOLATED_SPACINGS = 6.0
"""A point with fewer than `ISOLATED_NEIGHBOURS` others within this many spacings is isolated."""
FLOOR_CELL_M = 1.0
FLOOR_LAYER_M = 0.1
FLOOR_TOLERANCE_M = 0.3
"""Points lower than this below the floor around them are reflections ..."""
MAX_REFLECTION_SHARE = 0.15
"""... if they are at most this share of the points of their cell; more are a lower floor."""
MAX_CODE = 2**62


def far_outliers(xyz: F32, spacing: float) -> Bools:
    """Whether each point (N, 3) belongs to a small group far from the rest, or is isolated.

    Args:
        xyz: metres.
        spacing: typical distance between neighbouring points, metres.
    """
    group = _groups(xyz, max(MIN_FAR_CELL_M, FAR_CELL_SPACINGS * spacing))
    share = np.bincount(group) / len(xyz)
    far = share[group] < min(MIN_GROUP_SHARE, float(share.max()))
    return np.asarray(far | _isolated(xyz, ISOLATED_SPACINGS * spacing), bool)


def _isolated(xyz: F32, radius: float) -> Bools:
    """Whether each point (N, 3) has fewer than `ISOLATED_NEIGHBOURS` others within a radius.

    Only points in cells with few others are searched: the diagonal of a cell is shorter than the radius.
    """
    from scipy.spatial import cKDTree

    out = np.zeros(len(xyz), bool)
    index = _cells(xyz, 0.99 * radius / math.sqrt(3))[1]
    few = np.flatnonzero(np.bincount(index)[index] <= ISOLATED_NEIGHBOURS)
    if len(few):
        tree = cKDTree(xyz, balanced_tree=False, compact_nodes=False)  # several times faster to build
        near = tree.query(xyz[few], min(ISOLATED_NEIGHBOURS + 1, len(xyz)), workers=-1)[0][:, -1]
        out[few] = near > radius
    return out


def _cells(xyz: F32, size: float) -> tuple[I64, I64]:
    """Occupied cells (C, 3) of a grid, and the cell (N,) of each point."""
    cells = np.floor(xyz.astype(np.float64) / size).astype(np.int64)
    cells -= cells.min(axis=0)
    span = cells.max(axis=0) + 1
    if math.prod(span.tolist()) > MAX_CODE:  # a point is very far away
        occupied, index = np.unique(cells, axis=0, return_inverse=True)
        return occupied, index.ravel()
    order, code = stable_argsort((cells[:, 0] * span[1] + cells[:, 1]) * span[2] + cells[:, 2])
    first = first_of_each(code)
    index = np.empty(len(xyz), np.int64)
    index[order] = np.cumsum(first) - 1
    return cells[order[first]], index


def _groups(xyz: F32, cell: float) -> np.ndarray:
    """Connected group (N,) of each point; points in the same or in adjacent cells are connected."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    cells, index = _cells(xyz, cell)
    pairs = cKDTree(cells).query_pairs(1.8, output_type="ndarray")  # the diagonal of a cube is 1.73
    edges = coo_matrix((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(len(cells), len(cells)))
    return np.asarray(connected_components(edges, directed=False)[1][index])


def below_floor(xyz: F32) -> Bools:
    """Whether each point (N, 3; z up) is below the floor: a mirror image in a polished floor, or a multipath return."""
    cell = np.floor(xyz[:, :2].astype(np.float64) / FLOOR_CELL_M).astype(np.int64)
    cell -= cell.min(axis=0)
    key = cell[:, 0] * (cell[:, 1].max() + 1) + cell[:, 1]
    order, key = stable_argsort(key)
    starts = np.flatnonzero(first_of_each(key))
    out = np.zeros(len(xyz), bool)
    for first, end in zip(starts, np.append(starts[1:], len(order)), strict=True):
        z = xyz[order[first:end], 2].astype(np.float64)
        low = z.min()
        layers = np.bincount(((z - low) / FLOOR_LAYER_M).astype(np.int64))
        floor = low + FLOOR_LAYER_M * float(np.flatnonzero(layers >= MAX_REFLECTION_SHARE * len(z))[:1].sum())
        below = z < floor - FLOOR_TOLERANCE_M
        if below.mean() <= MAX_REFLECTION_SHARE:
            out[order[first:end][below]] = True
    return out
