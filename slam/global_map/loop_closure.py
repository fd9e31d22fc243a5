"""Loop closure: recognizes places that were passed before, and corrects the path by pose graph optimization.

Of each keyframe, a thumbnail of its horizon and its descriptors are indexed. Thumbnails are compared at all headings,
so that a 360 camera recognizes a street that it drives in the opposite direction. Similar keyframes are relocalized by
their descriptors, and a pose graph distributes the accumulated drift over the path. Leave it off to measure pure
odometry.
"""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.types import F32, F64, U8
from scan2sim.pipeline.geometry.least_squares import block_jacobian, cauchy_weights, moved
from scan2sim.slam.geometry import inverse, relative_pose_error
from scan2sim.slam.global_map.map_file import MapCheckpoint
from scan2sim.slam.global_map.sparse_model import sparse_points, update_map
from scan2sim.slam.odometry.relocalization import FrameFeatures, KeyframeFeatures, detect_features, relocalize
from scan2sim.slam.virtual_cameras import VirtualViews

THUMBNAIL_PX = 64, 12
"""Width and height."""
LOOP_MIN_M = 60.0
"""Least distance driven between two passes of a place."""
DRIFT_MAX_M, DRIFT_MAX_SHARE = 25.0, 0.05
"""Greatest drift between two passes: metres, plus a share of the distance driven."""
CORRELATION_MIN = 0.45
"""Least correlation of thumbnails to compare descriptors."""
CANDIDATE_EVERY = 2
"""Every Nth keyframe is a candidate for a loop."""
ODOMETRY_SIGMA = (0.01, 2e-4)
"""Standard deviation of the motion between keyframes: metres, and radians, each per square root of a metre driven."""
LOOP_SIGMA = (0.1, 2e-3)
"""Standard deviation of a relocalized pose: metres and radians."""
LOOP_CAUCHY_SCALE = 1e4
"""Squared scale of the Cauchy loss, which down-weights false loops."""


class KeyframeIndex:
    """Thumbnails and features of keyframes, for place recognition."""

    def __init__(self, views: VirtualViews) -> None:
        self.views = views
        self.thumbnail: dict[int, F32] = {}
        self.features: dict[int, FrameFeatures] = {}

    def add(self, keyframe: int, images: list[U8]) -> None:
        """Index a keyframe by its virtual views."""
        self.thumbnail[keyframe] = thumbnail(images[0])
        self.features[keyframe] = detect_features(self.views, images)


def thumbnail(image: U8) -> F32:
    """Thumbnail of mean 0 and norm 1; that of a 360 frame's horizon band covers one full turn."""
    import cv2

    small = cv2.resize(image, THUMBNAIL_PX, interpolation=cv2.INTER_AREA).astype(np.float32)
    small -= cv2.GaussianBlur(small, (0, 0), 6)
    return (small / max(float(np.linalg.norm(small)), 1e-6)).astype(np.float32)


def thumbnail_correlation(a: F32, b: F32, *, panoramic: bool) -> float:
    """Correlation of two thumbnails; of panoramic ones the maximum over all headings."""
    if not panoramic:
        return float((a * b).sum())
    spectrum = np.fft.rfft(a, axis=1) * np.conj(np.fft.rfft(b, axis=1))
    return float(np.fft.irfft(spectrum.sum(axis=0), n=a.shape[1]).max())


def correct_by_loops(checkpoint: MapCheckpoint, index: KeyframeIndex) -> dict[str, float]:
    """Detect loops, and correct keyframes and points by pose graph optimization, in place; returns metrics."""
    keyframes = checkpoint.map.keyframes
    poses = np.stack([k.T_world_cam for k in keyframes])
    travelled = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1))])
    loops = _detect_loops(checkpoint, index, poses, travelled)
    if loops:
        moved, known = optimize_pose_graph(poses, travelled, loops), sparse_points(checkpoint)
        first = np.zeros(len(known.xyz), np.int64)  # points move with the keyframe that observed them first
        first[known.point[::-1]] = known.keyframe[::-1]
        change = (moved @ inverse(poses))[first]
        xyz = np.einsum("pij,pj->pi", change[:, :3, :3], known.xyz) + change[:, :3, 3]
        update_map(checkpoint, known, moved, xyz)
    return {"loops": len(loops)}


def _detect_loops(
    checkpoint: MapCheckpoint, index: KeyframeIndex, poses: F64, travelled: F64
) -> list[tuple[int, int, F64]]:
    """Loops: (earlier keyframe, later keyframe, pose (4, 4) of the later in the earlier's axes)."""
    rng = np.random.default_rng(0)
    panoramic = not index.views.single
    last = -10
    loops = []
    for k in sorted(index.features):
        if k - last < 3:  # one loop in three keyframes is enough
            continue
        candidates = [
            j
            for j in list(index.features)[::CANDIDATE_EVERY]
            if travelled[k] - travelled[j] > LOOP_MIN_M
            and np.linalg.norm(poses[k, :3, 3] - poses[j, :3, 3])
            < DRIFT_MAX_M + DRIFT_MAX_SHARE * (travelled[k] - travelled[j])
            and j + 2 in index.features
        ]
        scores = [
            thumbnail_correlation(index.thumbnail[k], index.thumbnail[j], panoramic=panoramic) for j in candidates
        ]
        for best in np.argsort(scores)[::-1][:2]:
            j = candidates[best]
            if scores[best] < CORRELATION_MIN:
                break
            pair = [KeyframeFeatures(index.features[i], poses[i]) for i in (j, j + 2)]
            pose = relocalize(index.features[k], pair[0], pair[1], sigma=checkpoint.map.sigma, rng=rng)
            if pose is not None:
                loops.append((j, k, inverse(poses[j]) @ pose))
                last = k
                break
    return loops


def optimize_pose_graph(poses: F64, travelled: F64, loops: list[tuple[int, int, F64]], rounds: int = 10) -> F64:
    """(C, 4, 4) poses that best fit the motions between neighbours and the loops; the first pose is fixed.

    Args:
        poses: (C, 4, 4) camera to world.
        travelled: (C,) metres driven.
        loops: (earlier pose, later pose, pose (4, 4) of the later in the earlier's axes).
        rounds: maximum number of Gauss-Newton iterations.
    """
    from scipy.sparse.linalg import spsolve

    n = len(poses)
    pairs = np.array([*zip(range(n - 1), range(1, n), strict=True), *((a, b) for a, b, _ in loops)])
    measured = np.stack([*(inverse(poses[:-1]) @ poses[1:]), *(T for _, _, T in loops)])
    lengths = np.maximum(np.diff(travelled), 0.1)
    sigma = np.concatenate([np.outer(np.sqrt(lengths), ODOMETRY_SIGMA), np.tile(LOOP_SIGMA, (len(loops), 1))])
    whiten = np.repeat(1 / sigma, 3, axis=1)
    is_loop = np.arange(len(pairs)) >= n - 1
    poses = poses.copy()
    for _ in range(rounds):
        residual, J = relative_pose_error(poses[pairs[:, 0]], poses[pairs[:, 1]], measured)
        residual = residual * whiten
        root = np.sqrt(np.where(is_loop, cauchy_weights(residual, LOOP_CAUCHY_SCALE), 1.0))[:, None]
        jacobian = block_jacobian(J * (whiten * root)[:, None, :, None], pairs, n).tocsc()[:, 6:]
        step = -spsolve((jacobian.T @ jacobian).tocsc(), jacobian.T @ (residual * root).ravel()).reshape(-1, 6)
        poses[1:] = moved(poses[1:], step)
        if np.abs(step).max() < 1e-6:
            break
    return poses
