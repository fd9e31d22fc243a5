"""Smooth: photos' votes and the points' shape together, so that classes end at real edges. Import late: loads numba.

Shape is classified without photos (`segmentation.geometric`): how likely each class is to have a shape is a
table. A mean field over each point's nearest neighbours (Krahenbuhl and Koltun, NIPS 2011, on a graph instead of a
lattice) then lets alike neighbours agree: alike are those whose normals and colours are.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.types import F32, I32, U8, Bools, PointCloud
from scan2sim.segmentation.labels import CLASSES, GROUND, SKY
from scan2sim.segmentation.postprocess import by_height, with_feet, without_specks
from scan2sim.segmentation.votes import Votes

NEIGHBOURS = 24
ROUNDS = 10
PULL = 16.0
"""Weight of all neighbours together against a point's own evidence."""
TRUST = 0.25
"""Power of the shape's likelihood beside photos: features of one place aren't independent."""
ENOUGH = 0.6
"""Votes' weight at which a point's photos say all that they can."""
UNSURE = 0.02
UNSEEN = 0.05
"""Votes' weight up to which a point counts as unseen."""
REACH_GROUND, REACH, LENT, LENDERS = 4.0, 2.0, 1.0, 8
"""Metres over which the unseen takes after the seen, the share at no distance, and of how many."""
ABOVE = 0.4
"""Metres above ground: what no built thing or plant is and photos take for ground there was seen through: it moved."""
LIKELY: dict[str, dict[str, float]] = {
    # what the shape says: how often a class has it, against the others; what isn't named: 0.05
    "terrain": dict.fromkeys(GROUND, 1.0) | {"low_vegetation": 0.15, "vehicle": 0.08, "wall_or_fence": 0.08},
    "building": {"building": 1.0, "wall_or_fence": 0.4, "road_sign": 0.15, "high_vegetation": 0.15, "vehicle": 0.15,
                 "pole": 0.15, "low_vegetation": 0.1},
    "wall_or_fence": {"wall_or_fence": 1.0, "building": 0.6, "low_vegetation": 0.6, "vehicle": 0.2},
    "pole": {"pole": 1.0, "road_sign": 0.7, "high_vegetation": 0.5, "building": 0.15, "wall_or_fence": 0.15},
    "vehicle": {"vehicle": 1.0, "low_vegetation": 0.4, "wall_or_fence": 0.3, "person": 0.2, "building": 0.1},
    "vegetation": {"high_vegetation": 1.0, "low_vegetation": 1.0, "building": 0.25, "wall_or_fence": 0.3,
                   "vehicle": 0.25, "pole": 0.3, "road_sign": 0.3, "person": 0.3},
}  # fmt: skip
"""What the geometric classes say of the classes."""


def decide(
    votes: Votes,
    shape: U8,
    height: F32,
    moved: Bools,
    cloud: PointCloud,
    *,
    knows_low_vegetation: bool,
    normal_pull: float = 4.0,
) -> tuple[U8, F32]:
    """Index into `CLASSES` (N,), and its probability (N,).

    Args:
        votes: of the photos.
        shape: (N,) LAS codes classified by shape alone.
        height: (N,) metres above ground.
        moved: (N,) which points are of moving things (`segmentation.transient_points`).
        cloud: the points, with normals; colours are used where there are any.
        knows_low_vegetation: whether the network distinguishes low from high vegetation; else height does.
        normal_pull: sharpness by which neighbours with other normals count less.
    """
    from scipy.spatial import cKDTree

    unary = evidence(votes, shape, height, moved, knows_low_vegetation=knows_low_vegetation)
    k = min(NEIGHBOURS, len(cloud) - 1)
    tree = cKDTree(cloud.xyz)
    _borrow(unary, votes.weight, shape, cloud.xyz)
    _, near = tree.query(cloud.xyz, k + 1, workers=-1)
    near = near[:, 1:].astype(np.int32)
    assert cloud.normal is not None
    rgb = np.zeros((0, 3), np.uint8) if cloud.rgb is None else cloud.rgb
    alike = _alike(near, cloud.normal, rgb, normal_pull)
    settled = mean_field(unary, near, alike)
    best = settled.argmax(axis=1).astype(np.uint8)
    probability = np.empty_like(settled)  # agreeing neighbours make sure of anything: count them as one witness
    _settle(unary, settled, near, alike, probability, np.float32(1))
    sure = probability[np.arange(len(best)), best]
    best = without_specks(best, height, cloud.xyz, near[:, :8])
    best = with_feet(best, cloud.normal, near)
    return by_height(best, height, cloud.xyz), sure.astype(np.float32)


def likelihood(shape: U8) -> F32:
    """(N, C) how likely points of each class are to have `shape` (LAS codes classified by shape alone)."""
    plants = ("low_vegetation", "mid_vegetation", "high_vegetation")
    table = np.full((256, len(CLASSES)), 0.3, np.float32)
    for name, row in LIKELY.items():
        values = [row.get(c, 0.05) for c in CLASSES]
        for code in [CODE[p] for p in plants] if name == "vegetation" else [CODE[name]]:
            table[code] = values
    return table[shape]


def evidence(votes: Votes, shape: U8, height: F32, moved: Bools, *, knows_low_vegetation: bool) -> F32:
    """(N, C) logarithms of what photos and shape say of each point, by itself."""
    seen = np.minimum(1.0, votes.weight / ENOUGH)[:, None]
    share = votes.score / np.maximum(votes.weight, 1e-9)[:, None]
    flat = 1.0 / (len(CLASSES) - 1)
    photos = seen * share + (1 - seen) * flat
    if not knows_low_vegetation:  # a network that knows vegetation alone: height parts it
        low, high = CLASSES.index("low_vegetation"), CLASSES.index("high_vegetation")
        both = photos[:, low] + photos[:, high]
        tall = 1 / (1 + np.exp(-(height - 1.5) / 0.4))
        photos[:, high], photos[:, low] = both * tall, both * (1 - tall)
    vehicle = CLASSES.index("vehicle")
    trust = np.where(moved, np.where(shape == CODE["building"], 0.4, 0.85), 0.0).astype(np.float32)[:, None]
    photos = photos * (1 - trust)
    photos[:, vehicle] += trust[:, 0]
    through = (height > ABOVE) & np.isin(shape, (CODE["vehicle"], CODE["unclassified"]))
    ground = np.array([CLASSES.index(name) for name in GROUND])
    photos[through, vehicle] += photos[through][:, ground].sum(axis=1)
    photos[np.ix_(np.flatnonzero(through), ground)] = 0
    out = np.log(photos + UNSURE) + np.where(
        moved[:, None], 0, TRUST * np.log(likelihood(shape)) * (1 + 1.5 * (1 - seen))
    )
    out[:, SKY] = -20
    return out.astype(np.float32)


def _borrow(unary: F32, weight: F32, shape: U8, xyz: F32) -> None:
    """What no photo sees takes after the nearest that one sees: ground after ground, the rest after the rest."""
    from scipy.spatial import cKDTree

    ground = shape == CODE["terrain"]
    for kind, reach in ((ground, REACH_GROUND), (~ground, REACH)):
        want, have = np.flatnonzero(kind & (weight <= UNSEEN)), np.flatnonzero(kind & (weight > UNSEEN))
        if not len(want) or not len(have):
            continue
        k = min(LENDERS, len(have))
        distance, at = cKDTree(xyz[have]).query(xyz[want], k=[*range(1, k + 1)], workers=-1)
        near = (LENT * np.exp(-distance[:, 0] / reach))[:, None].astype(np.float32)
        lent = sum(unary[have[at[:, j]]] for j in range(k)) / np.float32(k)
        unary[want] += near * (lent - lent.max(axis=1, keepdims=True))


@njit(cache=True, parallel=True)
def _alike(near: I32, normals: F32, rgb: U8, pull: float) -> F32:
    """(N, K) float32 weights of neighbours that sum to 1 or less."""
    n, k = near.shape
    out = np.empty((n, k), np.float32)
    for i in prange(n):
        for j in range(k):
            o = near[i, j]
            dot = 0.0
            for c in range(3):
                dot += normals[i, c] * normals[o, c]
            w = math.exp(-pull * (1 - abs(dot)))
            if rgb.shape[0] > 0:
                d2 = 0.0
                for c in range(3):
                    d = (np.float64(rgb[i, c]) - np.float64(rgb[o, c])) / 40.0
                    d2 += d * d
                w *= 0.3 + 0.7 * math.exp(-0.5 * d2)
            out[i, j] = w / k
    return out


def mean_field(unary: F32, near: I32, alike: F32) -> F32:
    """(N, C) probabilities after `ROUNDS` rounds."""
    q = np.empty_like(unary)
    _settle(unary, unary, near, alike, q, np.float32(0))
    for _ in range(ROUNDS):
        new = np.empty_like(q)
        _settle(unary, q, near, alike, new, np.float32(PULL))
        q = new
    return q


@njit(cache=True, parallel=True)
def _settle(unary: F32, q: F32, near: I32, alike: F32, out: F32, pull: np.float32) -> None:
    n, classes = unary.shape
    for i in prange(n):
        most = -1e30
        for c in range(classes):
            value = unary[i, c]
            if pull > 0:
                for j in range(near.shape[1]):
                    value += pull * alike[i, j] * q[near[i, j], c]
            out[i, c] = value
            most = max(most, value)
        total = 0.0
        for c in range(classes):
            out[i, c] = math.exp(out[i, c] - most)
            total += out[i, c]
        for c in range(classes):
            out[i, c] /= total
