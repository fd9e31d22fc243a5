"""Tidy: what no neighbourhood mends: floating specks of vegetation, feet of walls, low vegetation that is high."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.types import F32, I32, U8
from scan2sim.segmentation.labels import CLASSES, GROUND

FLOATING, LINK = 0.35, 0.35
"""Vegetation whose lowest is so many metres above ground floats; its points are linked within so many."""
SPECK = 400
"""Voxels: smaller floating pieces of vegetation are none."""
PIECE, HUG, MOSTLY = 3000, 0.5, 0.6
"""Nor are larger ones of which so much lies within so many metres of a wall."""
UPRIGHT = 0.7
"""Normals that rise less are a wall's."""
HIGH, LOW = 2.6, 1.2
"""Metres above ground: vegetation higher is high; where nothing around is higher than the second, it is low."""


def without_specks(best: U8, height: F32, xyz: F32, near: I32) -> U8:
    """Small vegetation that touches no ground is what stands around it, bay windows and balconies: (N,) indices."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    plants = np.isin(best, [CLASSES.index("low_vegetation"), CLASSES.index("high_vegetation")])
    rows = np.flatnonzero(plants)
    if not len(rows):
        return best
    close = plants[near[rows]] & (np.linalg.norm(xyz[near[rows]] - xyz[rows, None], axis=2) < LINK)
    a, b = np.repeat(rows, near.shape[1])[close.ravel()], near[rows][close]
    _, part = connected_components(coo_matrix((np.ones(len(a), np.int8), (a, b)), shape=(len(best),) * 2), False)
    size, lowest = np.bincount(part[rows], minlength=len(best)), np.full(len(best), np.inf)
    np.minimum.at(lowest, part[rows], height[rows])
    walls = np.flatnonzero(np.isin(best, [CLASSES.index("building"), CLASSES.index("wall_or_fence")]))
    hugs = np.isfinite(cKDTree(xyz[walls]).query(xyz[rows], distance_upper_bound=HUG, workers=-1)[0])
    hugging = np.bincount(part[rows], hugs, minlength=len(best)) / np.maximum(size, 1)
    floats = plants & (lowest[part] > FLOATING)
    speck = floats & (size[part] < SPECK) | floats & (size[part] < PIECE) & (hugging[part] > MOSTLY)
    want, have = np.flatnonzero(speck), np.flatnonzero(~speck)
    if not len(want) or not len(have):
        return best
    k = min(15, len(have))
    around = best[have][cKDTree(xyz[have]).query(xyz[want], k=[*range(1, k + 1)], workers=-1)[1]]
    out = best.copy()
    out[want] = np.stack([(around == c).sum(axis=1) for c in range(len(CLASSES))], axis=1).argmax(axis=1)
    return out


def with_feet(best: U8, normal: F32, near: I32) -> U8:
    """The lowest rows of a wall, told as the ground before it, are the wall's: (N,) indices."""
    building = CLASSES.index("building")
    rows = np.flatnonzero(np.isin(best, [CLASSES.index(g) for g in GROUND]) & (np.abs(normal[:, 2]) < UPRIGHT))
    out = best.copy()
    out[rows[(best[near[rows]] == building).any(axis=1)]] = building
    return out


def by_height(best: U8, height: F32, xyz: F32) -> U8:
    """Vegetation told low or high against all reason is told anew: (N,) indices."""
    low, high = CLASSES.index("low_vegetation"), CLASSES.index("high_vegetation")
    plants = np.flatnonzero((best == low) | (best == high))
    if not len(plants):
        return best
    cells = np.floor((xyz[plants, :2] - xyz[:, :2].min(axis=0)) / 0.5).astype(np.int64)
    of = cells[:, 0] * (cells[:, 1].max() + 1) + cells[:, 1]
    _, of = np.unique(of, return_inverse=True)
    top = np.full(of.max() + 1, -np.inf, np.float32)
    np.maximum.at(top, of, height[plants])
    out = best.copy()
    out[plants[height[plants] > HIGH]] = high
    out[plants[top[of] < LOW]] = low
    return out
