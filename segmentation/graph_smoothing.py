"""Smoothing of point classes by a conditional random field (CRF) on the neighbourhood graph. Import late: loads numba.

Unary potentials combine the votes of the photos with the likelihood of each class given the shape, which is classified
without photos (`segmentation.geometric`). Mean field inference over each point's nearest neighbours (Krahenbuhl and
Koltun, NIPS 2011, on a graph instead of a lattice) makes similar neighbours agree, so that classes end at real edges;
the similarity depends on normals and colours.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.types import F32, I32, U8, Bools, PointCloud
from scan2sim.segmentation.labels import CLASSES, GROUND_CLASSES, SKY
from scan2sim.segmentation.postprocess import correct_vegetation_height, correct_wall_feet, remove_specks
from scan2sim.segmentation.votes import Votes

NEIGHBOURS = 24
MEAN_FIELD_ITERATIONS = 10
PAIRWISE_WEIGHT = 16.0
"""Weight of all neighbours together, relative to the unary potentials."""
SHAPE_LIKELIHOOD_POWER = 0.25
"""Exponent of the shape's likelihood beside photos: the evidence of neighbouring points is not independent."""
FULL_VOTE_WEIGHT = 0.6
"""Weight of votes from which the photos' probabilities count in full."""
PROBABILITY_FLOOR = 0.02
"""Added to the photos' probabilities before the logarithm."""
UNSEEN_VOTE_WEIGHT = 0.05
"""Weight of votes up to which a point counts as unseen."""
TRANSFER_DISTANCE_GROUND_M, TRANSFER_DISTANCE_M = 4.0, 2.0
"""Decay length in metres of the transfer of potentials from seen to unseen points, on the ground and above it."""
TRANSFER_WEIGHT, TRANSFER_NEIGHBOURS = 1.0, 8
"""Weight of the transfer at no distance, and number of seen neighbours that are averaged."""
SEEN_THROUGH_MIN_HEIGHT_M = 0.4
"""Height above ground from which points of vehicle or unclassified shape that photos classify as ground are assumed to
have been seen through: a moving vehicle."""
MOVABLE_CLASSES = ("vehicle", "person", "sky")
"""Classes that aren't alternatives to a vehicle that turns out to be none."""
SHAPE_LIKELIHOODS: dict[str, dict[str, float]] = {
    # by shape class: how often each class has this shape, relative to the other classes; 0.05 for classes not listed
    "terrain": dict.fromkeys(GROUND_CLASSES, 1.0) | {"low_vegetation": 0.15, "vehicle": 0.08, "wall_or_fence": 0.08},
    "building": {"building": 1.0, "wall_or_fence": 0.4, "road_sign": 0.15, "high_vegetation": 0.15, "vehicle": 0.15,
                 "pole": 0.15, "low_vegetation": 0.1},
    "wall_or_fence": {"wall_or_fence": 1.0, "building": 0.6, "low_vegetation": 0.6, "vehicle": 0.2},
    "pole": {"pole": 1.0, "road_sign": 0.7, "high_vegetation": 0.5, "building": 0.15, "wall_or_fence": 0.15},
    "vehicle": {"vehicle": 1.0, "low_vegetation": 0.4, "wall_or_fence": 0.3, "person": 0.2, "building": 0.1},
    "vegetation": {"high_vegetation": 1.0, "low_vegetation": 1.0, "building": 0.25, "wall_or_fence": 0.3,
                   "vehicle": 0.25, "pole": 0.3, "road_sign": 0.3, "person": 0.3},
}  # fmt: skip
"""Likelihood of each class given the class by shape alone."""


def smooth_classes(
    votes: Votes,
    shape: U8,
    height: F32,
    moved: Bools,
    cloud: PointCloud,
    *,
    knows_low_vegetation: bool,
    normal_pull: float = 4.0,
) -> tuple[U8, F32, U8]:
    """Class of each point, index into `CLASSES` (N,), its probability (N,), and its likeliest class if it stays (N,).

    Args:
        votes: votes of the photos.
        shape: (N,) LAS codes classified by shape alone.
        height: (N,) metres above ground.
        moved: (N,) points of moving objects (`segmentation.transient_points`).
        cloud: points with normals; colours are used if there are any.
        knows_low_vegetation: whether the network distinguishes low from high vegetation; otherwise height does.
        normal_pull: sharpness by which neighbours with other normals are down-weighted.
    """
    from scipy.spatial import cKDTree

    unary = unary_potentials(votes, shape, height, moved, knows_low_vegetation=knows_low_vegetation)
    k = min(NEIGHBOURS, len(cloud) - 1)
    tree = cKDTree(cloud.xyz)
    _transfer_to_unseen(unary, votes.weight, shape, cloud.xyz)
    _, near = tree.query(cloud.xyz, k + 1, workers=-1)
    near = near[:, 1:].astype(np.int32)
    assert cloud.normal is not None
    rgb = np.zeros((0, 3), np.uint8) if cloud.rgb is None else cloud.rgb
    similarity = _similarity(near, cloud.normal, rgb, normal_pull)
    marginals = mean_field(unary, near, similarity)
    best = marginals.argmax(axis=1).astype(np.uint8)
    # mean field is overconfident where neighbours agree: for the confidence all neighbours count as one observation
    probability = np.empty_like(marginals)
    _mean_field_step(unary, marginals, near, similarity, probability, np.float32(1))
    confidence = probability[np.arange(len(best)), best]
    best = remove_specks(best, height, cloud.xyz, near[:, :8])
    best = correct_wall_feet(best, cloud.normal, near)
    staying = np.where(np.isin(CLASSES, MOVABLE_CLASSES), 0, probability).argmax(axis=1).astype(np.uint8)
    return correct_vegetation_height(best, height, cloud.xyz), confidence.astype(np.float32), staying


def likelihood(shape: U8) -> F32:
    """(N, C) likelihood of `shape` (N,) (LAS codes classified by shape alone) for each class."""
    plants = ("low_vegetation", "mid_vegetation", "high_vegetation")
    table = np.full((256, len(CLASSES)), 0.3, np.float32)
    for name, row in SHAPE_LIKELIHOODS.items():
        values = [row.get(c, 0.05) for c in CLASSES]
        for code in [CODE[p] for p in plants] if name == "vegetation" else [CODE[name]]:
            table[code] = values
    return table[shape]


def unary_potentials(votes: Votes, shape: U8, height: F32, moved: Bools, *, knows_low_vegetation: bool) -> F32:
    """(N, C) log probabilities of the classes of each point by photos and shape, without its neighbours."""
    seen = np.minimum(1.0, votes.weight / FULL_VOTE_WEIGHT)[:, None]
    share = votes.score / np.maximum(votes.weight, 1e-9)[:, None]
    flat = 1.0 / (len(CLASSES) - 1)
    photos = seen * share + (1 - seen) * flat
    if not knows_low_vegetation:  # the network has one class of vegetation: split it by height
        low, high = CLASSES.index("low_vegetation"), CLASSES.index("high_vegetation")
        both = photos[:, low] + photos[:, high]
        tall = 1 / (1 + np.exp(-(height - 1.5) / 0.4))
        photos[:, high], photos[:, low] = both * tall, both * (1 - tall)
    vehicle = CLASSES.index("vehicle")
    trust = np.where(moved, np.where(shape == CODE["building"], 0.4, 0.85), 0.0).astype(np.float32)[:, None]
    photos = photos * (1 - trust)
    photos[:, vehicle] += trust[:, 0]
    through = (height > SEEN_THROUGH_MIN_HEIGHT_M) & np.isin(shape, (CODE["vehicle"], CODE["unclassified"]))
    ground = np.array([CLASSES.index(name) for name in GROUND_CLASSES])
    photos[through, vehicle] += photos[through][:, ground].sum(axis=1)
    photos[np.ix_(np.flatnonzero(through), ground)] = 0
    out = np.log(photos + PROBABILITY_FLOOR) + np.where(
        moved[:, None], 0, SHAPE_LIKELIHOOD_POWER * np.log(likelihood(shape)) * (1 + 1.5 * (1 - seen))
    )
    out[:, SKY] = -20
    return out.astype(np.float32)


def _transfer_to_unseen(unary: F32, weight: F32, shape: U8, xyz: F32) -> None:
    """Add the potentials of the nearest seen points to unseen points, in place; separately on and above the ground."""
    from scipy.spatial import cKDTree

    ground = shape == CODE["terrain"]
    for group, decay_length in ((ground, TRANSFER_DISTANCE_GROUND_M), (~ground, TRANSFER_DISTANCE_M)):
        unseen = np.flatnonzero(group & (weight <= UNSEEN_VOTE_WEIGHT))
        seen = np.flatnonzero(group & (weight > UNSEEN_VOTE_WEIGHT))
        if not len(unseen) or not len(seen):
            continue
        k = min(TRANSFER_NEIGHBOURS, len(seen))
        distance, at = cKDTree(xyz[seen]).query(xyz[unseen], k=[*range(1, k + 1)], workers=-1)
        share = (TRANSFER_WEIGHT * np.exp(-distance[:, 0] / decay_length))[:, None].astype(np.float32)
        mean = sum(unary[seen[at[:, j]]] for j in range(k)) / np.float32(k)
        unary[unseen] += share * (mean - mean.max(axis=1, keepdims=True))


@njit(cache=True, parallel=True)
def _similarity(near: I32, normals: F32, rgb: U8, normal_pull: float) -> F32:
    """(N, K) float32 weights of the neighbours by normals and colours; they sum to at most 1."""
    n, k = near.shape
    out = np.empty((n, k), np.float32)
    for i in prange(n):
        for j in range(k):
            o = near[i, j]
            dot = 0.0
            for c in range(3):
                dot += normals[i, c] * normals[o, c]
            w = math.exp(-normal_pull * (1 - abs(dot)))
            if rgb.shape[0] > 0:
                d2 = 0.0
                for c in range(3):
                    d = (np.float64(rgb[i, c]) - np.float64(rgb[o, c])) / 40.0
                    d2 += d * d
                w *= 0.3 + 0.7 * math.exp(-0.5 * d2)
            out[i, j] = w / k
    return out


def mean_field(unary: F32, near: I32, similarity: F32) -> F32:
    """(N, C) marginal probabilities after `MEAN_FIELD_ITERATIONS` iterations."""
    q = np.empty_like(unary)
    _mean_field_step(unary, unary, near, similarity, q, np.float32(0))
    for _ in range(MEAN_FIELD_ITERATIONS):
        new = np.empty_like(q)
        _mean_field_step(unary, q, near, similarity, new, np.float32(PAIRWISE_WEIGHT))
        q = new
    return q


@njit(cache=True, parallel=True)
def _mean_field_step(unary: F32, q: F32, near: I32, similarity: F32, out: F32, pairwise_weight: np.float32) -> None:
    """One mean field update of the probabilities `q` (N, C) into `out` (N, C)."""
    n, classes = unary.shape
    for i in prange(n):
        most = -1e30
        for c in range(classes):
            value = unary[i, c]
            if pairwise_weight > 0:
                for j in range(near.shape[1]):
                    value += pairwise_weight * similarity[i, j] * q[near[i, j], c]
            out[i, c] = value
            most = max(most, value)
        total = 0.0
        for c in range(classes):
            out[i, c] = math.exp(out[i, c] - most)
            total += out[i, c]
        for c in range(classes):
            out[i, c] /= total
