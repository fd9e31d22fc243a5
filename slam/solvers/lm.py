"""Levenberg-Marquardt with the Schur complement: eliminates points, solves cameras and shared parameters densely.

The residual is the cross product of observed and predicted direction, in its two components perpendicular to the
observed one, so that it has no singularity at seam or poles. As it also vanishes behind the camera, points there are
excluded. The Cauchy loss down-weights outliers. The kernels run on one thread: problems are small, and frames are
decoded in parallel.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from scan2sim.pipeline.core.types import F64, I32, I64, Bools
from scan2sim.slam.factor_graph import Factor, Graph, Solution
from scan2sim.slam.geometry import exp_so3

ITERATIONS_MAX = 8
COST_DECREASE_MIN = 1e-4
"""Relative decrease of the cost below which the iteration stops."""


def solve(graph: Graph, *, iterations: int | None = None, points: bool = True) -> Solution:
    """See `slam.solvers.Solver`."""
    poses, xyz, shared = graph.poses.copy(), graph.points.copy(), graph.shared.copy()
    free = np.cumsum(~graph.fixed).astype(np.int64) - 1
    free[graph.fixed] = -1
    starts = np.searchsorted(graph.point_of, np.arange(len(xyz) + 1))
    size = 6 * int((~graph.fixed).sum()) + len(shared)
    if not size and not points:
        return Solution(poses, xyz, shared)
    damping, cost = 1e-4, _cost(graph, poses, xyz, shared)
    for _ in range(ITERATIONS_MAX if iterations is None else iterations):
        H, g, V, gp, W = _normal(graph, poses, xyz, shared, free, starts, size, points)
        better = False
        for _ in range(6):
            step, moved = _step(H, g, V, gp, W, graph, free, starts, size, damping, points)
            new_poses, new_shared = _moved(poses, shared, step, graph.fixed)
            new_xyz = xyz + moved
            new_cost = _cost(graph, new_poses, new_xyz, new_shared)
            if new_cost <= cost:
                better = True
                break
            damping *= 10
        if not better:
            break
        decrease = (cost - new_cost) / max(cost, 1e-30)
        poses, xyz, shared, cost = new_poses, new_xyz, new_shared, new_cost
        damping = max(damping / 10, 1e-9)
        if decrease < COST_DECREASE_MIN:
            break
    return Solution(poses, xyz, shared)


def information(graph: Graph, *, points: bool = True) -> F64:
    """(6 C, 6 C) information matrix of the cameras from the observations alone, per squared radian.

    Points are eliminated; with `points` False, they are fixed instead.
    """
    count = len(graph.poses)
    free, starts = np.arange(count), np.searchsorted(graph.point_of, np.arange(len(graph.points) + 1))
    none = np.zeros((0, 0, 6)), np.zeros(0)
    H, g, V, gp, W = _accumulate(
        graph.poses, graph.points, starts, graph.camera_of, graph.bearing, *none, free, 6 * count, 1.0
    )
    return _reduce(H, g, V, gp, W, starts, graph.camera_of, free, 0, 0.0)[0] if points else H


def information_of_shared(graph: Graph) -> F64:
    """(S, S) information matrix of the shared parameters from the observations, for a sigma of 1.

    Points and cameras are eliminated.
    """
    S = graph.shared_jacobian.shape[1]
    size = 6 * len(graph.poses) + S
    free, starts = np.arange(len(graph.poses)), np.searchsorted(graph.point_of, np.arange(len(graph.points) + 1))
    H, g, V, gp, W = _accumulate(
        graph.poses, graph.points, starts, graph.camera_of, graph.bearing, graph.shared_jacobian, graph.shared, free,
        size, graph.sigma,
    )  # fmt: skip
    H = _reduce(H, g, V, gp, W, starts, graph.camera_of, free, S, 0.0)[0] * graph.sigma**2
    between = H[:-S, -S:]
    out = H[-S:, -S:] - between.T @ np.linalg.pinv(H[:-S, :-S], rcond=1e-9, hermitian=True) @ between
    return np.asarray(out, np.float64)


def _moved(poses: F64, shared: F64, step: F64, fixed: Bools) -> tuple[F64, F64]:
    out = poses.copy()
    n = int((~fixed).sum())
    by = step[: 6 * n].reshape(n, 6)
    out[~fixed, :3, 3] += by[:, :3]
    out[~fixed, :3, :3] = exp_so3(by[:, 3:]) @ out[~fixed, :3, :3]
    return out, shared + step[6 * n :]


def _prior_residual(graph: Graph, shared: F64) -> F64:
    """(S,) difference of the shared parameters from the mean of their prior."""
    return shared - (graph.shared if graph.shared_prior is None else graph.shared_prior)


def _cost(graph: Graph, poses: F64, xyz: F64, shared: F64) -> float:
    total = _robust_cost(
        poses, xyz, graph.point_of, graph.camera_of, graph.bearing, graph.shared_jacobian, shared, graph.sigma
    ).sum()
    for known in graph.distances:
        r = (np.linalg.norm(poses[known.second, :3, 3] - poses[known.first, :3, 3]) - known.distance) / known.sigma
        total += math.log1p(r * r)
    total += float(((_prior_residual(graph, shared) / graph.shared_sigma) ** 2).sum())
    for factor in graph.factors:
        residual = np.asarray(factor.residual(*(poses[c] for c in factor.cameras), factor.measured))
        total += float((residual**2).sum())
    return float(total)


def _normal(
    graph: Graph, poses: F64, xyz: F64, shared: F64, free: I64, starts: I64, size: int, points: bool
) -> tuple[F64, F64, F64, F64, F64]:
    """Normal equations: H, g of cameras and shared parameters; V, gp of points; W couples both."""
    H, g, V, gp, W = _accumulate(
        poses, xyz, starts, graph.camera_of, graph.bearing, graph.shared_jacobian, shared, free, size, graph.sigma
    )
    last = np.arange(size - len(shared), size)
    H[last, last] += 1 / graph.shared_sigma**2
    g[last] += _prior_residual(graph, shared) / graph.shared_sigma**2
    for known in graph.distances:
        between = poses[known.second, :3, 3] - poses[known.first, :3, 3]
        length = max(float(np.linalg.norm(between)), 1e-9)
        r = (length - known.distance) / known.sigma
        J = np.zeros((1, size))
        for camera, sign in ((known.second, 1), (known.first, -1)):
            if free[camera] >= 0:
                J[0, 6 * free[camera] : 6 * free[camera] + 3] = sign * between / length / known.sigma
        w = 1 / (1 + r * r)
        H += w * J.T @ J
        g += w * J[0] * r
    for factor in graph.factors:
        J, residual = _numeric_jacobian(factor, poses, free, size)
        H += J.T @ J
        g += J.T @ residual
    return H, g, V, gp, W


def _numeric_jacobian(factor: Factor, poses: F64, free: I64, size: int) -> tuple[F64, F64]:
    """Jacobian of a user-defined factor by central differences, and its residual."""
    involved = [poses[c] for c in factor.cameras]
    residual = np.atleast_1d(np.asarray(factor.residual(*involved, factor.measured), np.float64))
    J = np.zeros((len(residual), size))
    for k, camera in enumerate(factor.cameras):
        if free[camera] < 0:
            continue
        for d in range(6):
            ends = []
            for h in (1e-6, -1e-6):
                step = np.zeros((1, 6))
                step[0, d] = h
                moved, _ = _moved(involved[k][None], np.zeros(0), step.ravel(), np.zeros(1, bool))
                ends.append(np.asarray(factor.residual(*involved[:k], moved[0], *involved[k + 1 :], factor.measured)))
            J[:, 6 * free[camera] + d] = (ends[0] - ends[1]) / 2e-6
    return J, residual


def _step(
    H: F64,
    g: F64,
    V: F64,
    gp: F64,
    W: F64,
    graph: Graph,
    free: I64,
    starts: I64,
    size: int,
    damping: float,
    points: bool,
) -> tuple[F64, F64]:
    """Update of cameras and shared parameters (size,), and of points (P, 3)."""
    from scipy.linalg import LinAlgError, cho_factor, cho_solve

    fixed_points, n_shared = np.zeros((len(V), 3)), graph.shared_jacobian.shape[1]
    if points:
        reduced, right = _reduce(H, g, V, gp, W, starts, graph.camera_of, free, n_shared, damping)
    else:
        reduced, right = H.copy(), g.copy()
    if not size:
        return np.zeros(0), _back_substitute(np.zeros(0), V, gp, W, starts, graph.camera_of, free, n_shared, damping)
    diagonal = np.diag_indices(size)
    reduced[diagonal] += damping * H[diagonal] + 1e-12
    try:
        step = -cho_solve(cho_factor(reduced), right)
    except (LinAlgError, ValueError):
        return np.zeros(size), fixed_points
    if not points:
        return step, fixed_points
    return step, _back_substitute(step, V, gp, W, starts, graph.camera_of, free, n_shared, damping)


def _reduce(
    H: F64, g: F64, V: F64, gp: F64, W: F64, starts: I64, camera_of: I32, free: I64, n_shared: int, damping: float
) -> tuple[F64, F64]:
    """H and g of cameras and shared parameters with the points eliminated (Schur complement)."""
    less, less_g = _schur(V, gp, W, starts, camera_of, free, n_shared, len(g), damping)
    return H - less, g - less_g


@njit(cache=True, inline="always")
def _transformed(
    T: F64, X: F64, shared_jacobian: F64, shared: F64, R: F64
) -> tuple[float, float, float, float, float, float]:
    """Point in camera axes, and its offset in world axes; fills `R` (3, 3) with the rotation by shared parameters."""
    tx, ty, tz = T[0, 3], T[1, 3], T[2, 3]
    for r in range(3):
        for c in range(3):
            R[r, c] = T[r, c]
    if shared.shape[0] > 0:
        wx, wy, wz = 0.0, 0.0, 0.0
        for s in range(shared.shape[0]):
            tx += shared[s] * shared_jacobian[s, 0]
            ty += shared[s] * shared_jacobian[s, 1]
            tz += shared[s] * shared_jacobian[s, 2]
            wx += shared[s] * shared_jacobian[s, 3]
            wy += shared[s] * shared_jacobian[s, 4]
            wz += shared[s] * shared_jacobian[s, 5]
        for c in range(3):  # first order: these rotations are small
            a, b, d = T[0, c], T[1, c], T[2, c]
            R[0, c] = a + wy * d - wz * b
            R[1, c] = b + wz * a - wx * d
            R[2, c] = d + wx * b - wy * a
    dx, dy, dz = X[0] - tx, X[1] - ty, X[2] - tz
    return (
        R[0, 0] * dx + R[1, 0] * dy + R[2, 0] * dz,
        R[0, 1] * dx + R[1, 1] * dy + R[2, 1] * dz,
        R[0, 2] * dx + R[1, 2] * dy + R[2, 2] * dz,
        dx,
        dy,
        dz,
    )


@njit(cache=True, nogil=True)
def _robust_cost(
    poses: F64, xyz: F64, point_of: I32, camera_of: I32, bearing: F64, shared_jacobian: F64, shared: F64, sigma: float
) -> F64:
    """(O,) Cauchy cost of every observation; for points behind the camera, that of a right angle."""
    out = np.empty(len(point_of))
    none = np.zeros((0, 6))
    for o in range(len(point_of)):
        R = np.empty((3, 3))
        b = shared_jacobian[o] if shared.shape[0] > 0 else none
        x, y, z, _, _, _ = _transformed(poses[camera_of[o]], xyz[point_of[o]], b, shared, R)
        p, q, s = bearing[o, 0], bearing[o, 1], bearing[o, 2]
        cx, cy, cz = q * z - s * y, s * x - p * z, p * y - q * x
        r2 = x * x + y * y + z * z
        sine2 = (cx * cx + cy * cy + cz * cz) / max(r2, 1e-18)
        if p * x + q * y + s * z < 0:
            sine2 = 1.0
        out[o] = math.log1p(sine2 / (sigma * sigma))
    return out


@njit(cache=True, nogil=True)
def _accumulate(
    poses: F64,
    xyz: F64,
    starts: I64,
    camera_of: I32,
    bearing: F64,
    shared_jacobian: F64,
    shared: F64,
    free: I64,
    size: int,
    sigma: float,
) -> tuple[F64, F64, F64, F64, F64]:
    """Normal equations of the observations: H, g of cameras and shared parameters; V, gp of points; W couples both."""
    S = shared.shape[0]
    D = 6 + S
    n = len(starts) - 1
    H = np.zeros((size, size))
    g = np.zeros(size)
    V = np.zeros((n, 3, 3))
    gp = np.zeros((n, 3))
    W = np.zeros((len(camera_of), D, 3))
    none = np.zeros((0, 6))
    R = np.empty((3, 3))
    J = np.empty((2, D))
    Jp = np.empty((2, 3))
    r = np.empty(2)
    for p in range(n):
        for o in range(starts[p], starts[p + 1]):
            camera = camera_of[o]
            b = shared_jacobian[o] if S > 0 else none
            x, y, z, dx, dy, dz = _transformed(poses[camera], xyz[p], b, shared, R)
            length = math.sqrt(x * x + y * y + z * z)
            bx, by, bz = bearing[o, 0], bearing[o, 1], bearing[o, 2]
            if length < 1e-9 or bx * x + by * y + bz * z <= 0:
                continue
            ux, uy, uz = x / length, y / length, z / length
            # two directions perpendicular to the bearing
            if abs(bx) < 0.6:
                e1x, e1y, e1z = 0.0, bz, -by
            else:
                e1x, e1y, e1z = -bz, 0.0, bx
            norm = math.sqrt(e1x * e1x + e1y * e1y + e1z * e1z)
            e1x, e1y, e1z = e1x / norm, e1y / norm, e1z / norm
            e2x, e2y, e2z = by * e1z - bz * e1y, bz * e1x - bx * e1z, bx * e1y - by * e1x
            for k in range(2):
                ex, ey, ez = (e1x, e1y, e1z) if k == 0 else (e2x, e2y, e2z)
                dot = ex * ux + ey * uy + ez * uz
                r[k] = dot
                # e (I - u u') / length, rotated to world axes: derivative by the point
                fx, fy, fz = (ex - dot * ux) / length, (ey - dot * uy) / length, (ez - dot * uz) / length
                wx = R[0, 0] * fx + R[0, 1] * fy + R[0, 2] * fz
                wy = R[1, 0] * fx + R[1, 1] * fy + R[1, 2] * fz
                wz = R[2, 0] * fx + R[2, 1] * fy + R[2, 2] * fz
                Jp[k, 0], Jp[k, 1], Jp[k, 2] = wx, wy, wz
                J[k, 0], J[k, 1], J[k, 2] = -wx, -wy, -wz
                # rotating the camera by w moves the point relative to it by -w x d: derivative w . (f x d)
                J[k, 3], J[k, 4], J[k, 5] = wy * dz - wz * dy, wz * dx - wx * dz, wx * dy - wy * dx
                for s in range(S):
                    total = 0.0
                    for d in range(6):
                        total += J[k, d] * b[s, d]
                    J[k, 6 + s] = total
            w = 1.0 / (sigma * sigma) / (1.0 + (r[0] * r[0] + r[1] * r[1]) / (sigma * sigma))
            for i in range(3):
                gp[p, i] += w * (Jp[0, i] * r[0] + Jp[1, i] * r[1])
                for j in range(3):
                    V[p, i, j] += w * (Jp[0, i] * Jp[0, j] + Jp[1, i] * Jp[1, j])
            at = free[camera]
            for i in range(D):
                row = 6 * at + i if i < 6 else size - S + i - 6
                if i < 6 and at < 0:
                    continue
                g[row] += w * (J[0, i] * r[0] + J[1, i] * r[1])
                for j in range(3):
                    W[o, i, j] = w * (J[0, i] * Jp[0, j] + J[1, i] * Jp[1, j])
                for j in range(D):
                    if j < 6 and at < 0:
                        continue
                    column = 6 * at + j if j < 6 else size - S + j - 6
                    H[row, column] += w * (J[0, i] * J[0, j] + J[1, i] * J[1, j])
    return H, g, V, gp, W


@njit(cache=True, inline="always")
def _inverse3(A: F64, damping: float, out: F64) -> None:
    """Inverse of a damped symmetric (3, 3)."""
    a, b, c = A[0, 0] * (1 + damping) + 1e-9, A[0, 1], A[0, 2]
    d, e, f = A[1, 1] * (1 + damping) + 1e-9, A[1, 2], A[2, 2] * (1 + damping) + 1e-9
    det = a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)
    if abs(det) < 1e-30:
        out[:, :] = 0.0
        return
    out[0, 0], out[0, 1], out[0, 2] = (d * f - e * e) / det, (c * e - b * f) / det, (b * e - c * d) / det
    out[1, 0], out[1, 1], out[1, 2] = out[0, 1], (a * f - c * c) / det, (b * c - a * e) / det
    out[2, 0], out[2, 1], out[2, 2] = out[0, 2], out[1, 2], (a * d - b * b) / det


@njit(cache=True, nogil=True)
def _schur(
    V: F64, gp: F64, W: F64, starts: I64, camera_of: I32, free: I64, S: int, size: int, damping: float
) -> tuple[F64, F64]:
    """Schur complement: the terms that eliminating the points subtracts from H and g."""
    n = len(starts) - 1
    D = 6 + S
    H = np.zeros((size, size))
    g = np.zeros(size)
    inverse = np.empty((3, 3))
    WV = np.empty((D, 3))
    for p in range(n):
        _inverse3(V[p], damping, inverse)
        for a in range(starts[p], starts[p + 1]):
            at = free[camera_of[a]]
            for i in range(D):
                if i < 6 and at < 0:
                    continue
                row = 6 * at + i if i < 6 else size - S + i - 6
                for j in range(3):
                    WV[i, j] = W[a, i, 0] * inverse[0, j] + W[a, i, 1] * inverse[1, j] + W[a, i, 2] * inverse[2, j]
                g[row] += WV[i, 0] * gp[p, 0] + WV[i, 1] * gp[p, 1] + WV[i, 2] * gp[p, 2]
            for o in range(starts[p], starts[p + 1]):
                to = free[camera_of[o]]
                for i in range(D):
                    if i < 6 and at < 0:
                        continue
                    row = 6 * at + i if i < 6 else size - S + i - 6
                    for j in range(D):
                        if j < 6 and to < 0:
                            continue
                        column = 6 * to + j if j < 6 else size - S + j - 6
                        H[row, column] += WV[i, 0] * W[o, j, 0] + WV[i, 1] * W[o, j, 1] + WV[i, 2] * W[o, j, 2]
    return H, g


@njit(cache=True, nogil=True)
def _back_substitute(
    step: F64, V: F64, gp: F64, W: F64, starts: I64, camera_of: I32, free: I64, S: int, damping: float
) -> F64:
    """(P, 3) update of the points from that of the cameras."""
    n = len(starts) - 1
    size = len(step)
    D = 6 + S
    out = np.zeros((n, 3))
    for p in range(n):
        inverse = np.empty((3, 3))
        right = np.empty(3)
        for j in range(3):
            right[j] = gp[p, j]
        for o in range(starts[p], starts[p + 1]):
            at = free[camera_of[o]]
            for i in range(D):
                if i < 6 and at < 0:
                    continue
                row = 6 * at + i if i < 6 else size - S + i - 6
                for j in range(3):
                    right[j] += W[o, i, j] * step[row]
        _inverse3(V[p], damping, inverse)
        for i in range(3):
            out[p, i] = -(inverse[i, 0] * right[0] + inverse[i, 1] * right[1] + inverse[i, 2] * right[2])
    return out
