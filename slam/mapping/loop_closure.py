"""Loops: places that were passed before are recognised, and the path is bent so that they coincide.

A keyframe is remembered as a thumbnail of its horizon and its descriptors. Thumbnails are compared at all headings, so
that a 360 camera knows a street that it drives back. What looks alike is then placed by descriptors against the old
keyframes' points, and a pose graph spreads the difference over the path. For pure odometry, leave it off.
"""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.types import F32, F64, U8
from scan2sim.slam.geometry import exp_so3, inverse, log_so3
from scan2sim.slam.mapping.map_file import Mapped
from scan2sim.slam.mapping.sparse_model import kept, move
from scan2sim.slam.odometry.relocalization import Remembered, Seen, describe, relocalise
from scan2sim.slam.odometry.virtual_cameras import Facets

THUMBNAIL = 64, 12
APART = 60.0
"""Metres driven between two passes of a place, at least."""
NEAR = 25.0
DRIFT = 0.05
"""A place may have drifted by so many metres, plus so much of the way between."""
ALIKE = 0.45
"""Correlation of thumbnails from which on descriptors are compared."""
EVERY = 2
"""Keyframes are compared with every so manieth that was before."""
ODOMETRY = (0.01, 2e-4)
"""Standard deviation of a step between keyframes: of its length, and radians a metre."""
LOOP = (0.1, 2e-3)
"""Of a recognised place: metres and radians."""


class Places:
    """Remembers keyframes."""

    def __init__(self, facets: Facets) -> None:
        self.facets = facets
        self.thumbnail: dict[int, F32] = {}
        self.seen: dict[int, Seen] = {}

    def __call__(self, keyframe: int, pictures: list[U8]) -> None:
        """The facets of a keyframe."""
        self.thumbnail[keyframe] = thumbnail(pictures[0])
        self.seen[keyframe] = describe(self.facets, pictures)


def thumbnail(picture: U8) -> F32:
    """A small picture of mean 0 and length 1; of a panorama's band, its rows go once around."""
    import cv2

    small = cv2.resize(picture, THUMBNAIL, interpolation=cv2.INTER_AREA).astype(np.float32)
    small -= cv2.GaussianBlur(small, (0, 0), 6)
    return (small / max(float(np.linalg.norm(small)), 1e-6)).astype(np.float32)


def alike(a: F32, b: F32, *, around: bool) -> float:
    """Correlation of two thumbnails, at the best heading where they go around."""
    if not around:
        return float((a * b).sum())
    spectrum = np.fft.rfft(a, axis=1) * np.conj(np.fft.rfft(b, axis=1))
    return float(np.fft.irfft(spectrum.sum(axis=0), n=a.shape[1]).max())


def close(mapped: Mapped, places: Places) -> dict[str, float]:
    """Find loops and bend the keyframes' path; figures."""
    keyframes = mapped.map.keyframes
    poses = np.stack([k.T_world_cam for k in keyframes])
    way = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1))])
    loops = _find(mapped, places, poses, way)
    if loops:
        moved, known = pose_graph(poses, way, loops), kept(mapped)
        first = np.zeros(len(known.xyz), np.int64)  # points go where the keyframe goes that saw them first
        first[known.point[::-1]] = known.keyframe[::-1]
        change = (moved @ inverse(poses))[first]
        xyz = np.einsum("pij,pj->pi", change[:, :3, :3], known.xyz) + change[:, :3, 3]
        move(mapped, known, moved, xyz)
    return {"loops": len(loops)}


def _find(mapped: Mapped, places: Places, poses: F64, way: F64) -> list[tuple[int, int, F64]]:
    """(earlier keyframe, later keyframe, pose (4, 4) of the later in the earlier's axes)."""
    rng = np.random.default_rng(0)
    around = not places.facets.whole
    last = -10
    found = []
    for k in sorted(places.seen):
        if k - last < 3:  # one loop in three keyframes is enough
            continue
        before = [
            j
            for j in list(places.seen)[::EVERY]
            if way[k] - way[j] > APART
            and np.linalg.norm(poses[k, :3, 3] - poses[j, :3, 3]) < NEAR + DRIFT * (way[k] - way[j])
            and j + 2 in places.seen
        ]
        scores = [alike(places.thumbnail[k], places.thumbnail[j], around=around) for j in before]
        for at in np.argsort(scores)[::-1][:2]:
            j = before[at]
            if scores[at] < ALIKE:
                break
            pair = [Remembered(places.seen[i], poses[i]) for i in (j, j + 2)]
            placed = relocalise(places.seen[k], pair[0], pair[1], sigma=mapped.map.sigma, rng=rng)
            if placed is not None:
                found.append((j, k, inverse(poses[j]) @ placed))
                last = k
                break
    return found


def pose_graph(poses: F64, way: F64, loops: list[tuple[int, int, F64]], rounds: int = 10) -> F64:
    """(C, 4, 4) poses that fit steps between neighbours and loops; the first stays."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.linalg import spsolve

    n = len(poses)
    steps = np.maximum(np.diff(way), 0.1)
    first = np.concatenate([np.arange(n - 1), [a for a, _, _ in loops]]).astype(int)
    second = np.concatenate([np.arange(1, n), [b for _, b, _ in loops]]).astype(int)
    measured = np.concatenate([inverse(poses[:-1]) @ poses[1:], np.array([T for _, _, T in loops]).reshape(-1, 4, 4)])
    sigma_t = np.concatenate([ODOMETRY[0] * np.sqrt(steps), np.full(len(loops), LOOP[0])])
    sigma_r = np.concatenate([ODOMETRY[1] * np.sqrt(steps), np.full(len(loops), LOOP[1])])
    is_loop = np.arange(len(first)) >= n - 1
    poses = poses.copy()
    for _ in range(rounds):
        Ri, Rj = poses[first, :3, :3], poses[second, :3, :3]
        between = poses[second, :3, 3] - poses[first, :3, 3]
        RiT = Ri.transpose(0, 2, 1)
        r_t = (RiT @ between[:, :, None])[:, :, 0] - measured[:, :3, 3]
        r_r = log_so3(measured[:, :3, :3].transpose(0, 2, 1) @ RiT @ Rj)
        residual = np.concatenate([r_t / sigma_t[:, None], r_r / sigma_r[:, None]], axis=1)
        weight = np.where(is_loop, 1 / (1 + (residual**2).sum(axis=1) / 1e4), 1.0)  # false loops count little
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
    """(N, 3, 3) matrices that multiply w (3,) to v x w."""
    out = np.zeros((len(v), 3, 3))
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return out - out.transpose(0, 2, 1)
