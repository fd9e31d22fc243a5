"""Relocalise: where a frame is, from two keyframes that were seen before, by descriptors, whatever lies between.

ORB on the facets of the sphere; what both keyframes see becomes points, what the frame sees of them places it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2sim.pipeline.core.types import F64, U8
from scan2sim.slam.geometry import angles, epipolar_errors, essential, inverse, relative_pose, rigid, triangulate
from scan2sim.slam.mapping.factor_graph import Graph
from scan2sim.slam.odometry.virtual_cameras import Facets
from scan2sim.slam.solvers import lm

FEATURES = 2500
RATIO = 0.8
"""Of distances of descriptors, of the best to the second best match."""
ENOUGH = 25
"""Points that must agree."""


@dataclass(frozen=True)
class Seen:
    """A frame's features: bearings (N, 3), descriptors (N, D)."""

    bearing: F64
    descriptor: U8


@dataclass(frozen=True)
class Remembered:
    """A keyframe's features and its pose (4, 4)."""

    seen: Seen
    T_world_cam: F64


def describe(facets: Facets, pictures: list[U8], masks: list[U8] | None = None) -> Seen:
    """ORB features of a frame's facets."""
    import cv2

    orb = cv2.ORB_create(FEATURES, fastThreshold=7)
    bearings, descriptors = [np.zeros((0, 3))], [np.zeros((0, 32), np.uint8)]
    for facet, picture in enumerate(pictures):
        points, found = orb.detectAndCompute(picture, None if masks is None else masks[facet])
        if found is None:
            continue
        bearing = facets.bearings(facet, np.array([p.pt for p in points]))
        good = np.isfinite(bearing[:, 0])
        good[good] = facets.place(bearing[good]) == facet
        bearings.append(bearing[good])
        descriptors.append(found[good])
    return Seen(np.concatenate(bearings), np.concatenate(descriptors))


def matches(a: U8, b: U8) -> np.ndarray:
    """(M, 2) rows of descriptors that are each other's best match, and clearly so."""
    import cv2

    if len(a) < 2 or len(b) < 2:
        return np.zeros((0, 2), np.int64)
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
    there = {m.queryIdx: m.trainIdx for m, n in matcher.knnMatch(a, b, k=2) if m.distance < RATIO * n.distance}
    back = {m.queryIdx: m.trainIdx for m, n in matcher.knnMatch(b, a, k=2) if m.distance < RATIO * n.distance}
    return np.array([(i, j) for i, j in there.items() if back.get(j) == i], np.int64).reshape(-1, 2)


def relocalise(
    now: Seen, before: Remembered, beside: Remembered, *, sigma: float, rng: np.random.Generator
) -> F64 | None:
    """Pose (4, 4) of a frame, camera to world; None if too little agrees.

    Args:
        now: the frame's features.
        before, beside: two keyframes some way apart.
        sigma: radians, of a bearing.
        rng: for samples.
    """
    pairs = matches(before.seen.descriptor, beside.seen.descriptor)
    E = essential(inverse(beside.T_world_cam) @ before.T_world_cam)
    a, b = before.seen.bearing[pairs[:, 0]], beside.seen.bearing[pairs[:, 1]]
    pairs = pairs[epipolar_errors(E, a, b) < 4 * sigma]
    if len(pairs) < ENOUGH:
        return None
    rays = np.stack([before.seen.bearing[pairs[:, 0]], beside.seen.bearing[pairs[:, 1]]], axis=1).reshape(-1, 3)
    cameras = np.tile(np.array([0, 1], np.int32), len(pairs))
    poses = np.stack([before.T_world_cam, beside.T_world_cam])
    xyz, angle = triangulate(poses, np.arange(0, 2 * len(pairs) + 1, 2), cameras, rays)
    good = np.isfinite(xyz[:, 0]) & (angle > 10 * sigma)
    rows, xyz = pairs[good, 0], xyz[good]
    seen = matches(before.seen.descriptor[rows], now.descriptor)
    if len(seen) < ENOUGH:
        return None
    xyz, bearing = xyz[seen[:, 0]], now.bearing[seen[:, 1]]
    found = relative_pose(before.seen.bearing[rows[seen[:, 0]]], bearing, threshold=4 * sigma, rng=rng)
    if found is None:
        return None
    turn, way = found[0][:3, :3], found[0][:3, 3]
    n, best = len(xyz), (0, np.eye(4))
    for far in (0.0, 2.0, 5.0, 10.0, 20.0):
        guess = before.T_world_cam @ rigid(turn, far * way)
        graph = Graph(
            guess[None], xyz, np.arange(n, dtype=np.int32), np.zeros(n, np.int32), bearing, np.zeros(1, bool), sigma
        )
        pose = lm.solve(graph, points=False, iterations=20).poses[0]
        agree = int((angles(pose, xyz, bearing) < 4 * sigma).sum())
        best = max(best, (agree, pose), key=lambda item: item[0])
    return best[1] if best[0] >= max(ENOUGH, 0.4 * n) else None
