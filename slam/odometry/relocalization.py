"""Relocalization: the pose of a frame from two earlier keyframes, by matching descriptors.

ORB features of the virtual views are matched between both keyframes and triangulated; the frame's matches with these
points give its pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2sim.pipeline.core.types import F64, U8
from scan2sim.slam.factor_graph import Graph
from scan2sim.slam.geometry import angles, epipolar_errors, essential, inverse, relative_pose, rigid, triangulate
from scan2sim.slam.solvers import lm
from scan2sim.slam.virtual_cameras import VirtualViews

ORB_FEATURES = 2500
"""Per virtual view."""
RATIO_MAX = 0.8
"""Ratio test: distance of the best match by that of the second best."""
INLIERS_MIN, INLIER_SHARE_MIN = 25, 0.4
"""Number of matches needed, and of inliers; inliers also as a share of the matches."""
GATE_SIGMAS = 4
"""Standard deviations of a bearing within which a match is an inlier."""
INITIAL_DISTANCES_M = (0.0, 2.0, 5.0, 10.0, 20.0)
"""Distances from the first keyframe at which the pose optimization is started: the relative pose has no scale."""


@dataclass(frozen=True)
class FrameFeatures:
    """Features of a frame: bearings (N, 3) and descriptors (N, D)."""

    bearing: F64
    descriptor: U8


@dataclass(frozen=True)
class KeyframeFeatures:
    """Features of a keyframe, and its pose (4, 4), camera to world."""

    features: FrameFeatures
    T_world_cam: F64


def detect_features(views: VirtualViews, images: list[U8], masks: list[U8] | None = None) -> FrameFeatures:
    """ORB features of a frame's virtual views."""
    import cv2

    orb = cv2.ORB_create(ORB_FEATURES, fastThreshold=7)
    bearings, descriptors = [np.zeros((0, 3))], [np.zeros((0, 32), np.uint8)]
    for view, image in enumerate(images):
        points, found = orb.detectAndCompute(image, None if masks is None else masks[view])
        if found is None:
            continue
        bearing = views.bearings(view, np.array([p.pt for p in points]))
        good = np.isfinite(bearing[:, 0])
        good[good] = views.view_of(bearing[good]) == view
        bearings.append(bearing[good])
        descriptors.append(found[good])
    return FrameFeatures(np.concatenate(bearings), np.concatenate(descriptors))


def match_descriptors(a: U8, b: U8) -> np.ndarray:
    """(M, 2) rows of binary descriptors that are mutual nearest neighbours and pass the ratio test."""
    import cv2

    if len(a) < 2 or len(b) < 2:
        return np.zeros((0, 2), np.int64)
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
    forward = {m.queryIdx: m.trainIdx for m, n in matcher.knnMatch(a, b, k=2) if m.distance < RATIO_MAX * n.distance}
    backward = {m.queryIdx: m.trainIdx for m, n in matcher.knnMatch(b, a, k=2) if m.distance < RATIO_MAX * n.distance}
    return np.array([(i, j) for i, j in forward.items() if backward.get(j) == i], np.int64).reshape(-1, 2)


def relocalize(
    now: FrameFeatures, first: KeyframeFeatures, second: KeyframeFeatures, *, sigma: float, rng: np.random.Generator
) -> F64 | None:
    """Pose (4, 4) of a frame, camera to world; None if there are too few inliers.

    Args:
        now: the frame's features.
        first, second: two keyframes with a baseline between them.
        sigma: standard deviation of a bearing, radians.
        rng: random numbers for RANSAC.
    """
    gate = GATE_SIGMAS * sigma
    pairs = match_descriptors(first.features.descriptor, second.features.descriptor)
    E = essential(inverse(second.T_world_cam) @ first.T_world_cam)
    a, b = first.features.bearing[pairs[:, 0]], second.features.bearing[pairs[:, 1]]
    pairs = pairs[epipolar_errors(E, a, b) < gate]
    if len(pairs) < INLIERS_MIN:
        return None
    rays = np.stack([first.features.bearing[pairs[:, 0]], second.features.bearing[pairs[:, 1]]], axis=1).reshape(-1, 3)
    cameras = np.tile(np.array([0, 1], np.int32), len(pairs))
    poses = np.stack([first.T_world_cam, second.T_world_cam])
    xyz, angle = triangulate(poses, np.arange(0, 2 * len(pairs) + 1, 2), cameras, rays)
    good = np.isfinite(xyz[:, 0]) & (angle > 10 * sigma)
    rows, xyz = pairs[good, 0], xyz[good]
    seen = match_descriptors(first.features.descriptor[rows], now.descriptor)
    if len(seen) < INLIERS_MIN:
        return None
    xyz, bearing = xyz[seen[:, 0]], now.bearing[seen[:, 1]]
    found = relative_pose(first.features.bearing[rows[seen[:, 0]]], bearing, threshold=gate, rng=rng)
    if found is None:
        return None
    rotation, direction = found[0][:3, :3], found[0][:3, 3]
    n, best = len(xyz), (0, np.eye(4))
    for metres in INITIAL_DISTANCES_M:
        guess = first.T_world_cam @ rigid(rotation, metres * direction)
        graph = Graph(
            guess[None], xyz, np.arange(n, dtype=np.int32), np.zeros(n, np.int32), bearing, np.zeros(1, bool), sigma
        )
        pose = lm.solve(graph, points=False, iterations=20).poses[0]
        inliers = int((angles(pose, xyz, bearing) < gate).sum())
        best = max(best, (inliers, pose), key=lambda item: item[0])
    return best[1] if best[0] >= max(INLIERS_MIN, INLIER_SHARE_MIN * n) else None
