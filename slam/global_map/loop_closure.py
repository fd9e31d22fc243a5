"""Loop closure: recognizes places that were passed before, and corrects the path by pose graph optimization.

Of each keyframe, a thumbnail of its horizon and its descriptors are indexed. Thumbnails are compared at all headings,
so that a 360 camera recognizes a street that it drives in the opposite direction. Similar keyframes are relocalized by
their descriptors, and a pose graph distributes the accumulated drift over the path. Leave it off to measure pure
odometry.
"""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.types import F32, F64, U8
from scan2sim.slam.geometry import exp_so3, inverse, log_so3
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
    from scipy.sparse import coo_matrix
    from scipy.sparse.linalg import spsolve

    n = len(poses)
    lengths = np.maximum(np.diff(travelled), 0.1)
    first = np.concatenate([np.arange(n - 1), [a for a, _, _ in loops]]).astype(int)
    second = np.concatenate([np.arange(1, n), [b for _, b, _ in loops]]).astype(int)
    measured = np.concatenate([inverse(poses[:-1]) @ poses[1:], np.array([T for _, _, T in loops]).reshape(-1, 4, 4)])
    sigma_t = np.concatenate([ODOMETRY_SIGMA[0] * np.sqrt(lengths), np.full(len(loops), LOOP_SIGMA[0])])
    sigma_r = np.concatenate([ODOMETRY_SIGMA[1] * np.sqrt(lengths), np.full(len(loops), LOOP_SIGMA[1])])
    is_loop = np.arange(len(first)) >= n - 1
    poses = poses.copy()
    for _ in range(rounds):
        Ri, Rj = poses[first, :3, :3], poses[second, :3, :3]
        between = poses[second, :3, 3] - poses[first, :3, 3]
        RiT = Ri.transpose(0, 2, 1)
        r_t = (RiT @ between[:, :, None])[:, :, 0] - measured[:, :3, 3]
        r_r = log_so3(measured[:, :3, :3].transpose(0, 2, 1) @ RiT @ Rj)
        residual = np.concatenate([r_t / sigma_t[:, None], r_r / sigma_r[:, None]], axis=1)
        weight = np.where(is_loop, 1 / (1 + (residual**2).sum(axis=1) / 1e4), 1.0)  # down-weights false loops
        J_i, J_j = np.zeros((len(first), 6, 6)), np.zeros((len(first), 6, 6))
        J_i[:, :3, :3], J_j[:, :3, :3] = -RiT, RiT
        J_i[:, :3, 3:] = RiT @ _cross(between)
        J_i[:, 3:, 3:], J_j[:, 3:, 3:] = -Rj.transpose(0, 2, 1), Rj.transpose(0, 2, 1)
        scale = np.repeat(np.stack([1 / sigma_t, 1 / sigma_r], axis=1), 3, axis=1) * np.sqrt(weight)[:, None]
        J_i, J_j = J_i * scale[:, :, None], J_j * scale[:, :, None]
        residual = residual * np.sqrt(weight)[:, None]
        rows = np.arange(6 * len(first)).reshape(-1, 6)
        at = np.concatenate([np.repeat(rows, 6, axis=1).ravel()] * 2)
        columns = np.concatenate([np.tile(6 * of[:, None] + np.arange(6), (1, 6)).ravel() for of in (first, second)])
        J = coo_matrix((np.concatenate([J_i.ravel(), J_j.ravel()]), (at, columns)), shape=(6 * len(first), 6 * n))
        J = J.tocsc()[:, 6:]
        step = -spsolve((J.T @ J).tocsc(), J.T @ residual.ravel()).reshape(-1, 6)
        poses[1:, :3, 3] += step[:, :3]
        poses[1:, :3, :3] = exp_so3(step[:, 3:]) @ poses[1:, :3, :3]
        if np.abs(step).max() < 1e-6:
            break
    return poses


def _cross(v: F64) -> F64:
    """(N, 3, 3) cross-product matrices of vectors v (N, 3): [v] w = v x w."""
    out = np.zeros((len(v), 3, 3))
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return out - out.transpose(0, 2, 1)
