"""Rule-based correction of point classes: floating specks, feet of walls, heights of vegetation."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.types import F32, I32, U8, Bools
from scan2sim.segmentation.labels import CLASSES, GROUND_CLASSES

FLOATING_MIN_HEIGHT_M, LINK_DISTANCE_M = 0.35, 0.35
"""A component floats if its lowest point is higher than this above ground; its points are linked within 0.35 m."""
SPECK_MAX_VOXELS = 400
"""Floating components of vegetation or ground with fewer voxels are wrong."""
WALL_PIECE_MAX_VOXELS, WALL_DISTANCE_M, WALL_SHARE_MIN = 3000, 0.5, 0.6
"""So are floating components of vegetation with fewer than 3000 voxels, of which 60 % lie within 0.5 m of a wall."""
WALL_MAX_NORMAL_Z = 0.7
"""Largest |z| of the normals of a wall."""
HIGH_VEGETATION_MIN_M, LOW_VEGETATION_MAX_M = 2.6, 1.2
"""Heights above ground: vegetation is high above the first, and low where nothing in its cell is above the second."""


def remove_specks(best: U8, height: F32, xyz: F32, near: I32) -> U8:
    """(N,) class indices with small floating components of vegetation and ground replaced by the class around them.

    Bay windows and balconies are often classified as vegetation, and the interior of cars, seen through their windows,
    as ground.
    """
    plants = np.isin(best, [CLASSES.index("low_vegetation"), CLASSES.index("high_vegetation")])
    ground = np.isin(best, [CLASSES.index(name) for name in GROUND_CLASSES])
    walls = np.isin(best, [CLASSES.index("building"), CLASSES.index("wall_or_fence")])
    speck = _specks(plants, height, xyz, near, xyz[walls]) | _specks(ground, height, xyz, near)
    want, have = np.flatnonzero(speck), np.flatnonzero(~speck & ~ground)
    out = best.copy()
    if len(want) and len(have):
        out[want] = _majority_class(best[have], xyz[have], xyz[want])
    return out


def _specks(member: Bools, height: F32, xyz: F32, near: I32, walls: F32 | None = None) -> Bools:
    """(N,) members of small floating components, or of larger ones that lie along `walls` (M, 3)."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    rows = np.flatnonzero(member)
    if not len(rows):
        return member
    close = member[near[rows]] & (np.linalg.norm(xyz[near[rows]] - xyz[rows, None], axis=2) < LINK_DISTANCE_M)
    a, b = np.repeat(rows, near.shape[1])[close.ravel()], near[rows][close]
    n = len(member)
    _, part = connected_components(coo_matrix((np.ones(len(a), np.int8), (a, b)), shape=(n, n)), False)
    size, lowest = np.bincount(part[rows], minlength=n), np.full(n, np.inf)
    np.minimum.at(lowest, part[rows], height[rows])
    small = size < SPECK_MAX_VOXELS
    if walls is not None:
        near_wall = np.isfinite(cKDTree(walls).query(xyz[rows], distance_upper_bound=WALL_DISTANCE_M, workers=-1)[0])
        wall_share = np.bincount(part[rows], near_wall, minlength=n) / np.maximum(size, 1)
        small |= (size < WALL_PIECE_MAX_VOXELS) & (wall_share > WALL_SHARE_MIN)
    return np.asarray(member & ((lowest > FLOATING_MIN_HEIGHT_M) & small)[part])


def _majority_class(best: U8, xyz: F32, positions: F32) -> U8:
    """(M,) most frequent class among the 15 points nearest to each position."""
    from scipy.spatial import cKDTree

    k = min(15, len(best))
    around = best[cKDTree(xyz).query(positions, k=[*range(1, k + 1)], workers=-1)[1]]
    return np.asarray(
        np.stack([(around == c).sum(axis=1) for c in range(len(CLASSES))], axis=1).argmax(axis=1), np.uint8
    )


def correct_wall_feet(best: U8, normal: F32, near: I32) -> U8:
    """(N,) class indices with upright ground points beside buildings, the feet of walls, changed to building."""
    building = CLASSES.index("building")
    rows = np.flatnonzero(
        np.isin(best, [CLASSES.index(g) for g in GROUND_CLASSES]) & (np.abs(normal[:, 2]) < WALL_MAX_NORMAL_Z)
    )
    out = best.copy()
    out[rows[(best[near[rows]] == building).any(axis=1)]] = building
    return out


def correct_vegetation_height(best: U8, height: F32, xyz: F32) -> U8:
    """(N,) class indices with low or high vegetation that contradicts its height changed to the other."""
    low, high = CLASSES.index("low_vegetation"), CLASSES.index("high_vegetation")
    plants = np.flatnonzero((best == low) | (best == high))
    if not len(plants):
        return best
    cells = np.floor((xyz[plants, :2] - xyz[:, :2].min(axis=0)) / 0.5).astype(np.int64)
    cell = cells[:, 0] * (cells[:, 1].max() + 1) + cells[:, 1]
    _, cell = np.unique(cell, return_inverse=True)
    top = np.full(cell.max() + 1, -np.inf, np.float32)
    np.maximum.at(top, cell, height[plants])
    out = best.copy()
    out[plants[height[plants] > HIGH_VEGETATION_MIN_M]] = high
    out[plants[top[cell] < LOW_VEGETATION_MAX_M]] = low
    return out
