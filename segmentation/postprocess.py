"""Tidy: what no neighbourhood mends: specks of plants and of road in the air, feet of walls, plants' heights."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.types import F32, I32, U8, Bools
from scan2sim.segmentation.labels import CLASSES, GROUND

FLOATING, LINK = 0.35, 0.35
"""What has its lowest so many metres above ground floats; its points are linked within so many."""
SPECK = 400
"""Voxels: smaller floating pieces of vegetation or ground are none."""
PIECE, HUG, MOSTLY = 3000, 0.5, 0.6
"""Nor is larger vegetation of which so much lies within so many metres of a wall."""
UPRIGHT = 0.7
"""Normals that rise less are a wall's."""
HIGH, LOW = 2.6, 1.2
"""Metres above ground: vegetation higher is high; where nothing around is higher than the second, it is low."""


def without_specks(best: U8, height: F32, xyz: F32, near: I32) -> U8:
    """(N,) indices of classes; small vegetation that touches no ground is what stands around it.

    Bay windows and balconies are taken for such. So is ground in the air, as photos take the inside of a car for that
    is seen through its window.
    """
    plants = np.isin(best, [CLASSES.index("low_vegetation"), CLASSES.index("high_vegetation")])
    ground = np.isin(best, [CLASSES.index(name) for name in GROUND])
    walls = np.isin(best, [CLASSES.index("building"), CLASSES.index("wall_or_fence")])
    speck = _specks(plants, height, xyz, near, xyz[walls]) | _specks(ground, height, xyz, near)
    want, have = np.flatnonzero(speck), np.flatnonzero(~speck & ~ground)
    out = best.copy()
    if len(want) and len(have):
        out[want] = _most_around(best[have], xyz[have], xyz[want])
    return out


def _specks(member: Bools, height: F32, xyz: F32, near: I32, walls: F32 | None = None) -> Bools:
    """(N,) which members are of small pieces that touch no ground, or of larger ones that hug `walls` (M, 3)."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    rows = np.flatnonzero(member)
    if not len(rows):
        return member
    close = member[near[rows]] & (np.linalg.norm(xyz[near[rows]] - xyz[rows, None], axis=2) < LINK)
    a, b = np.repeat(rows, near.shape[1])[close.ravel()], near[rows][close]
    n = len(member)
    _, part = connected_components(coo_matrix((np.ones(len(a), np.int8), (a, b)), shape=(n, n)), False)
    size, lowest = np.bincount(part[rows], minlength=n), np.full(n, np.inf)
    np.minimum.at(lowest, part[rows], height[rows])
    small = size < SPECK
    if walls is not None:
        hugs = np.isfinite(cKDTree(walls).query(xyz[rows], distance_upper_bound=HUG, workers=-1)[0])
        hugging = np.bincount(part[rows], hugs, minlength=n) / np.maximum(size, 1)
        small |= (size < PIECE) & (hugging > MOSTLY)
    return np.asarray(member & ((lowest > FLOATING) & small)[part])


def _most_around(best: U8, xyz: F32, places: F32) -> U8:
    """(M,) the class that most of the 15 points nearest to each place have."""
    from scipy.spatial import cKDTree

    k = min(15, len(best))
    around = best[cKDTree(xyz).query(places, k=[*range(1, k + 1)], workers=-1)[1]]
    return np.asarray(
        np.stack([(around == c).sum(axis=1) for c in range(len(CLASSES))], axis=1).argmax(axis=1), np.uint8
    )


def with_feet(best: U8, normal: F32, near: I32) -> U8:
    """The lowest rows of a wall, classified as the ground before it, are the wall's: (N,) indices."""
    building = CLASSES.index("building")
    rows = np.flatnonzero(np.isin(best, [CLASSES.index(g) for g in GROUND]) & (np.abs(normal[:, 2]) < UPRIGHT))
    out = best.copy()
    out[rows[(best[near[rows]] == building).any(axis=1)]] = building
    return out


def by_height(best: U8, height: F32, xyz: F32) -> U8:
    """Vegetation classified low or high against all reason is classified anew: (N,) indices."""
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
