"""Outliers of a map: far returns that inflate its extent, isolated points, and reflections below the floor."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.types import F32, Bools

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


def far_outliers(xyz: F32, spacing: float) -> Bools:
    """Whether each point (N, 3) belongs to a small group far from the rest, or is isolated.

    Args:
        xyz: metres.
        spacing: typical distance between neighbouring points, metres.
    """
    from scipy.spatial import cKDTree

    group = _groups(xyz, max(MIN_FAR_CELL_M, FAR_CELL_SPACINGS * spacing))
    share = np.bincount(group) / len(xyz)
    out = share[group] < min(MIN_GROUP_SHARE, float(share.max()))
    near = cKDTree(xyz).query(xyz, min(ISOLATED_NEIGHBOURS + 1, len(xyz)), workers=-1)[0][:, -1]
    return np.asarray(out | (near > ISOLATED_SPACINGS * spacing), bool)


def _groups(xyz: F32, cell: float) -> np.ndarray:
    """Connected group (N,) of each point; points in the same or in adjacent cells are connected."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    cells, index = np.unique(np.floor(xyz.astype(np.float64) / cell).astype(np.int64), axis=0, return_inverse=True)
    pairs = cKDTree(cells).query_pairs(1.8, output_type="ndarray")  # the diagonal of a cube is 1.73
    edges = coo_matrix((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(len(cells), len(cells)))
    return np.asarray(connected_components(edges, directed=False)[1][index.ravel()])


def below_floor(xyz: F32) -> Bools:
    """Whether each point (N, 3; z up) is below the floor: a mirror image in a polished floor, or a multipath return."""
    cell = np.floor(xyz[:, :2].astype(np.float64) / FLOOR_CELL_M).astype(np.int64)
    cell -= cell.min(axis=0)
    key = cell[:, 0] * (cell[:, 1].max() + 1) + cell[:, 1]
    order = np.lexsort((xyz[:, 2], key))
    starts = np.flatnonzero(np.diff(key[order], prepend=-1))
    out = np.zeros(len(xyz), bool)
    for first, end in zip(starts, np.append(starts[1:], len(order)), strict=True):
        z = xyz[order[first:end], 2].astype(np.float64)
        layers = np.bincount(((z - z[0]) / FLOOR_LAYER_M).astype(np.int64))
        floor = z[0] + FLOOR_LAYER_M * float(np.flatnonzero(layers >= MAX_REFLECTION_SHARE * len(z))[:1].sum())
        below = z < floor - FLOOR_TOLERANCE_M
        if below.mean() <= MAX_REFLECTION_SHARE:
            out[order[first:end][below]] = True
    return out
