"""Geometry of bearings: rotations, triangulation, relative pose of two cameras. Uses numba: import it late.

Bearings are unit vectors in camera axes: they work with any camera model, without special cases at seam or poles.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from scan2sim.pipeline.core.types import F64, I32, I64, Bools
from scan2sim.pipeline.geometry.least_squares import skew


def exp_so3(w: npt.ArrayLike) -> F64:
    """(..., 3, 3) rotation matrices of rotation vectors (..., 3), radians."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(np.asarray(w, np.float64)).as_matrix()


def log_so3(R: npt.ArrayLike) -> F64:
    """(..., 3) rotation vectors, radians, of rotation matrices (..., 3, 3)."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(np.asarray(R, np.float64)).as_rotvec()


def rigid(R: F64, t: F64) -> F64:
    """Pose (4, 4) of a rotation (3, 3) and a translation (3,)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def inverse(T: F64) -> F64:
    """Inverse of poses (..., 4, 4)."""
    out = np.zeros_like(T)
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    out[..., :3, :3], out[..., 3, 3] = Rt, 1
    out[..., :3, 3] = -(Rt @ T[..., :3, 3:])[..., 0]
    return out


def lever_arm_jacobian(arm: F64) -> F64:
    """(..., 6, 6) Jacobian of a pose at offset `arm` (..., 3) from another one, by that other pose.

    Of position (m) and rotation (rad) about world axes.
    """
    out = np.zeros((*arm.shape[:-1], 6, 6))
    out[..., range(6), range(6)] = 1
    out[..., :3, 3:] = -skew(arm)
    return out


def relative_pose_error(first: F64, second: F64, measured: F64) -> tuple[F64, F64]:
    """Errors (K, 6) of relative poses, metres and radians in the second's measured axes, and their Jacobian.

    Args:
        first, second: (K, 4, 4) poses.
        measured: (K, 4, 4) measured pose of the second in the first's axes.

    Returns:
        errors; (K, 2, 6, 6) derivatives by the first and the second pose, position and rotation about world axes.
    """
    R, between = second[:, :3, :3], second[:, :3, 3] - first[:, :3, 3]
    to_first, to_second = first[:, :3, :3].transpose(0, 2, 1), measured[:, :3, :3].transpose(0, 2, 1)
    A = to_second @ to_first
    shift = np.einsum("kab,kb->ka", to_first, between) - measured[:, :3, 3]
    error = np.concatenate([np.einsum("kab,kb->ka", to_second, shift), log_so3(A @ R)], axis=1)
    J = np.zeros((len(R), 2, 6, 6))
    J[:, 0, :3, :3], J[:, 1, :3, :3] = -A, A
    J[:, 0, :3, 3:] = A @ skew(between)
    J[:, 0, 3:, 3:], J[:, 1, 3:, 3:] = -R.transpose(0, 2, 1), R.transpose(0, 2, 1)
    return error, J


@njit(cache=True, nogil=True)
def triangulate(poses: F64, starts: I64, camera_of: I32, bearing: F64) -> tuple[F64, F64]:
    """Triangulate points: least squares of the distances to their rays, and the widest angle between two rays.

    Args:
        poses: (C, 4, 4) camera to world.
        starts: (P + 1,) observations of point p are starts[p] to starts[p + 1].
        camera_of: (O,) camera of each observation.
        bearing: (O, 3) unit vectors, camera axes.

    Returns:
        (P, 3) points, NaN where rays are parallel or intersect behind a camera, and (P,) angles, radians.
    """
    n = len(starts) - 1
    points = np.full((n, 3), np.nan)
    angle = np.zeros(n)
    for p in range(n):
        A = np.zeros((3, 3))
        b = np.zeros(3)
        first = starts[p]
        count = starts[p + 1] - first
        rays = np.empty((count, 3))
        for k in range(count):
            T = poses[camera_of[first + k]]
            for r in range(3):
                rays[k, r] = (
                    T[r, 0] * bearing[first + k, 0] + T[r, 1] * bearing[first + k, 1] + T[r, 2] * bearing[first + k, 2]
                )
            for r in range(3):
                for c in range(3):
                    m = (1.0 if r == c else 0.0) - rays[k, r] * rays[k, c]
                    A[r, c] += m
                    b[r] += m * T[c, 3]
        widest = 1.0
        for k in range(count):
            for j in range(k):
                dot = rays[k, 0] * rays[j, 0] + rays[k, 1] * rays[j, 1] + rays[k, 2] * rays[j, 2]
                widest = min(widest, dot)
        angle[p] = math.acos(min(1.0, max(-1.0, widest)))
        det = (
            A[0, 0] * (A[1, 1] * A[2, 2] - A[1, 2] * A[2, 1])
            - A[0, 1] * (A[1, 0] * A[2, 2] - A[1, 2] * A[2, 0])
            + A[0, 2] * (A[1, 0] * A[2, 1] - A[1, 1] * A[2, 0])
        )
        if count < 2 or det < 1e-12:
            continue
        x = np.linalg.solve(A, b)
        front = True
        for k in range(count):
            T = poses[camera_of[first + k]]
            depth = 0.0
            for r in range(3):
                depth += (x[r] - T[r, 3]) * rays[k, r]
            front = front and depth > 0.05
        if front:
            points[p] = x
    return points, angle


def angles(poses: F64, points: F64, bearing: F64) -> F64:
    """(N,) angles, radians, between bearings (N, 3) and points (N, 3); poses (4, 4) or (N, 4, 4) camera to world."""
    seen = ((points - poses[..., :3, 3])[:, None, :] @ poses[..., :3, :3])[:, 0]
    return np.arctan2(np.linalg.norm(np.cross(seen, bearing), axis=1), np.einsum("ni,ni->n", seen, bearing))


def epipolar_errors(E: F64, a: F64, b: F64) -> F64:
    """(..., N) symmetric epipolar errors, radians, of bearings a, b (N, 3) for E (..., 3, 3) with b' E a = 0."""
    la, lb = a @ np.swapaxes(E, -1, -2), b @ E
    sine = np.abs(np.einsum("...nk,nk->...n", la, b))
    na, nb = np.linalg.norm(la, axis=-1), np.linalg.norm(lb, axis=-1)
    return sine / np.maximum(np.minimum(na, nb), 1e-12)


def essential(T: F64) -> F64:
    """Essential matrix (3, 3) of the pose (4, 4) of camera a in the axes of camera b: b' E a = 0."""
    return skew(T[:3, 3] / max(float(np.linalg.norm(T[:3, 3])), 1e-9)) @ T[:3, :3]


def relative_pose(
    a: F64, b: F64, *, threshold: float, rng: np.random.Generator, rounds: int = 300
) -> tuple[F64, Bools] | None:
    """Relative pose (4, 4) of camera b in camera a's axes, with a unit baseline, and the inliers (N,).

    RANSAC with the eight-point algorithm on bearings (Hartley's linear method), then refined on all inliers.

    Args:
        a, b: (N, 3) bearings of the same features in both cameras.
        threshold: greatest epipolar error of an inlier, radians.
        rng: for the samples.
        rounds: number of samples.

    Returns:
        the pose and inliers (N,); None if no pose fits half of them.
    """
    n = len(a)
    if n < 12:
        return None
    rows = np.einsum("ni,nj->nij", b, a).reshape(n, 9)
    pick = np.argsort(rng.random((rounds, n)), axis=1)[:, :8] if n < 400 else rng.integers(0, n, (rounds, 8))
    _, _, vt = np.linalg.svd(rows[pick], full_matrices=True)
    E = _nearest_essential(vt[:, 8].reshape(-1, 3, 3))
    some = slice(None) if n <= 500 else rng.permutation(n)[:500]
    errors = epipolar_errors(E, a[some], b[some])
    best = E[np.minimum(errors, 3 * threshold).sum(axis=1).argmin()]
    inlier = epipolar_errors(best, a, b) < threshold
    for _ in range(4):
        if inlier.sum() < 12:
            return None
        w = 1 / (1 + (epipolar_errors(best, a, b)[inlier] / (0.5 * threshold)) ** 2)
        _, _, vt = np.linalg.svd(rows[inlier] * w[:, None], full_matrices=False)
        best = _nearest_essential(vt[-1].reshape(1, 3, 3))[0]
        inlier = epipolar_errors(best, a, b) < threshold
    if inlier.sum() < max(12, 0.5 * n):
        return None
    return _decompose(best, a, b, inlier)


def _nearest_essential(E: F64) -> F64:
    """(B, 3, 3) essential matrices nearest to given matrices (B, 3, 3)."""
    u, _, vt = np.linalg.svd(E)
    return u @ np.diag([1.0, 1.0, 0.0]) @ vt


def _decompose(E: F64, a: F64, b: F64, inlier: Bools) -> tuple[F64, Bools]:
    """Pose with most points in front of both cameras, among the four that E allows, and these points (N,)."""
    u, _, vt = np.linalg.svd(E)
    u, vt = u * np.sign(np.linalg.det(u)), vt * np.sign(np.linalg.det(vt))
    W = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    best: tuple[int, F64, Bools] | None = None
    index: I32 = np.flatnonzero(inlier).astype(np.int32)
    starts = np.arange(0, 2 * len(index) + 1, 2)
    cameras = np.tile(np.array([0, 1], np.int32), len(index))
    rays = np.stack([a[index], b[index]], axis=1).reshape(-1, 3)
    for R in (u @ W @ vt, u @ W.T @ vt):
        for t in (u[:, 2], -u[:, 2]):
            T = inverse(rigid(R, t))  # x_b = R x_a + t
            points, _ = triangulate(np.stack([np.eye(4), T]), starts, cameras, rays)
            front = ~np.isnan(points[:, 0])
            if best is None or front.sum() > best[0]:
                keep = np.zeros(len(a), bool)
                keep[index[front]] = True
                best = int(front.sum()), T, keep
    assert best is not None
    return best[1], best[2]
