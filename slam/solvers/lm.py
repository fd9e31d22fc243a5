"""Levenberg-Marquardt with the Schur complement: eliminates points, solves cameras and shared parameters densely.

The residual is the cross product of observed and predicted direction, in its two components perpendicular to the
observed one, so that it has no singularity at seam or poles. As it also vanishes behind the camera, points there are
excluded. The Cauchy loss down-weights outliers. The kernels run on one thread: problems are small, and frames are
decoded in parallel.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numba import njit

from scan2sim.pipeline.core.types import F64, I32, I64, Bools
from scan2sim.pipeline.geometry.least_squares import moved
from scan2sim.slam.factor_graph import Factor, Graph, Solution

ITERATIONS_MAX = 8
COST_DECREASE_MIN = 1e-4
"""Relative decrease of the cost below which the iteration stops."""
WINDOW_COST_DECREASE_MIN = 1e-3
"""The same of a window, by default: it is optimized again with each of the next keyframes."""


class Normal(NamedTuple):
    """Normal equations.

    Attributes:
        H, g: (N, N), (N,) of free cameras and shared parameters.
        V, gp: (P, 3, 3), (P, 3) of points.
        W: (O, D, 3) coupling of each observation's point with its camera and the shared parameters.
        starts: (P + 1,) observations of point p are starts[p] to starts[p + 1].
        columns: (O, D) columns of H of these parameters; -1: fixed.
    """

    H: F64
    g: F64
    V: F64
    gp: F64
    W: F64
    starts: I64
    columns: I64


def solve(graph: Graph, *, iterations: int | None = None, points: bool = True) -> Solution:
    """See `slam.solvers.Solver`."""
    start = Solution(graph.poses, graph.points, graph.shared)
    if graph.fixed.all() and not len(graph.shared) and not points:
        return start
    known = layout(graph.point_of, graph.camera_of, graph.fixed, len(graph.points), len(graph.shared))
    normal_of = partial(_normal, graph, known)
    return minimize(
        start, graph.fixed, partial(_cost, graph), normal_of, iterations, points=points,
        decrease_min=WINDOW_COST_DECREASE_MIN if points and iterations is None else COST_DECREASE_MIN,
    )  # fmt: skip


def minimize(
    start: Solution,
    fixed: Bools,
    cost_of: Callable[[F64, F64, F64], float],
    normal_of: Callable[[F64, F64, F64], Normal],
    iterations: int | None = None,
    *,
    points: bool = True,
    decrease_min: float = COST_DECREASE_MIN,
) -> Solution:
    """Minimize a cost of poses, points and shared parameters by Levenberg-Marquardt.

    Args:
        start: initial values.
        fixed: (C,) whether a camera is fixed.
        cost_of: cost of poses (C, 4, 4), points (P, 3) and shared parameters (S,).
        normal_of: normal equations at such values.
        iterations: greatest number of iterations; default: `ITERATIONS_MAX`.
        points: optimize the points, too.
        decrease_min: relative decrease of the cost below which the iteration stops.
    """
    poses, xyz, shared = start.poses.copy(), start.points.copy(), start.shared.copy()
    damping, cost = 1e-4, cost_of(poses, xyz, shared)
    for _ in range(ITERATIONS_MAX if iterations is None else iterations):
        normal = normal_of(poses, xyz, shared)
        better = False
        for _ in range(6):
            step, point_step = _step(normal, damping, points)
            new_poses, new_shared = _moved(poses, shared, step, fixed)
            new_xyz = xyz + point_step
            new_cost = cost_of(new_poses, new_xyz, new_shared)
            if new_cost <= cost:
                better = True
                break
            damping *= 10
        if not better:
            break
        decrease = (cost - new_cost) / max(cost, 1e-30)
        poses, xyz, shared, cost = new_poses, new_xyz, new_shared, new_cost
        damping = max(damping / 10, 1e-9)
        if decrease < decrease_min:
            break
    return Solution(poses, xyz, shared)


def information(graph: Graph, *, points: bool = True) -> F64:
    """(6 C, 6 C) information matrix of the cameras from the observations alone, per squared radian.

    Points are eliminated; with `points` False, they are fixed instead.
    """
    bare = replace(graph, fixed=np.zeros(len(graph.poses), bool), shared_jacobian=np.zeros((0, 0, 6)), sigma=1.0)
    known = layout(bare.point_of, bare.camera_of, bare.fixed, len(bare.points), 0)
    normal = _observations(bare, known, graph.poses, graph.points, np.zeros(0))
    return _reduce(normal, 0.0)[0] if points else normal.H


def information_of_shared(normal: Normal, count: int) -> F64:
    """(S, S) information matrix of the last `count` parameters; points and cameras are eliminated."""
    H = _reduce(normal, 0.0)[0]
    between = H[:-count, -count:]
    rest = np.linalg.pinv(H[:-count, :-count], rcond=1e-9, hermitian=True)
    return np.asarray(H[-count:, -count:] - between.T @ rest @ between, np.float64)


def layout(point_of: I32, camera_of: I32, fixed: Bools, points: int, shared: int) -> tuple[I64, I64, int]:
    """Layout of the normal equations: `Normal.starts`, `Normal.columns`, and the number of columns of H.

    Args:
        point_of, camera_of: (O,) point and camera of each observation, sorted by point.
        fixed: (C,) whether a camera is fixed.
        points: number of points.
        shared: number of shared parameters.
    """
    first = 6 * _free(fixed)[camera_of, None]
    size = 6 * int((~fixed).sum()) + shared
    of_shared = np.tile(np.arange(size - shared, size), (len(first), 1))
    columns = np.concatenate([np.where(first < 0, -1, first + np.arange(6)), of_shared], axis=1)
    return np.searchsorted(point_of, np.arange(points + 1)), columns, size


def _moved(poses: F64, shared: F64, step: F64, fixed: Bools) -> tuple[F64, F64]:
    out, end = poses.copy(), len(step) - len(shared)
    out[~fixed] = moved(out[~fixed], step[:end].reshape(-1, 6))
    return out, shared + step[end:]


def _cost(graph: Graph, poses: F64, xyz: F64, shared: F64) -> float:
    total = _robust_cost(
        poses, xyz, graph.point_of, graph.camera_of, graph.bearing, graph.shared_jacobian, shared, graph.sigma
    ).sum()
    for known in graph.distances:
        r = (np.linalg.norm(poses[known.second, :3, 3] - poses[known.first, :3, 3]) - known.distance) / known.sigma
        total += math.log1p(r * r)
    total += float((((shared - graph.shared) / graph.shared_sigma) ** 2).sum())
    for factor in graph.factors:
        residual = np.asarray(factor.residual(*(poses[c] for c in factor.cameras), factor.measured))
        total += float((residual**2).sum())
    return float(total)


def _free(fixed: Bools) -> I64:
    """(C,) indices of the free cameras; -1 for fixed ones."""
    return np.where(fixed, -1, np.cumsum(~fixed) - 1)


def _observations(graph: Graph, known: tuple[I64, I64, int], poses: F64, xyz: F64, shared: F64) -> Normal:
    """Normal equations of the observations alone; `known`: their `layout`."""
    starts, columns, size = known
    equations = _accumulate(
        poses, xyz, starts, graph.camera_of, graph.bearing, graph.shared_jacobian, shared, columns, size, graph.sigma
    )
    return Normal(*equations, starts, columns)


def _normal(graph: Graph, arranged: tuple[I64, I64, int], poses: F64, xyz: F64, shared: F64) -> Normal:
    """Normal equations of all factors; `arranged`: the `layout` of the observations."""
    normal, free = _observations(graph, arranged, poses, xyz, shared), _free(graph.fixed)
    H, g, size = normal.H, normal.g, len(normal.g)
    last = np.arange(size - len(shared), size)
    H[last, last] += 1 / graph.shared_sigma**2
    g[last] += (shared - graph.shared) / graph.shared_sigma**2
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
    return normal


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
                other = moved(involved[k][None], step)[0]
                ends.append(np.asarray(factor.residual(*involved[:k], other, *involved[k + 1 :], factor.measured)))
            J[:, 6 * free[camera] + d] = (ends[0] - ends[1]) / 2e-6
    return J, residual


def _step(normal: Normal, damping: float, points: bool) -> tuple[F64, F64]:
    """Update of cameras and shared parameters (N,), and of points (P, 3)."""
    from scipy.linalg.lapack import dposv  # without the checks of scipy.linalg, which cost as much

    H, g, V, gp, W, starts, columns = normal
    step, fixed_points = np.zeros(len(g)), np.zeros((len(V), 3))
    if len(g):
        reduced, right = _reduce(normal, damping) if points else (H.copy(), g)
        reduced[np.diag_indices(len(g))] += damping * np.diagonal(H) + 1e-12
        _, solution, failed = dposv(reduced, right)
        if failed:
            return step, fixed_points
        step = -solution
    return step, _back_substitute(step, V, gp, W, starts, columns, damping) if points else fixed_points


def _reduce(normal: Normal, damping: float) -> tuple[F64, F64]:
    """H and g of cameras and shared parameters with the points eliminated (Schur complement)."""
    H, g, V, gp, W, starts, columns = normal
    less, less_g = _schur(V, gp, W, starts, columns, len(g), damping)
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
    none, R = np.zeros((0, 6)), np.empty((3, 3))
    for o in range(len(point_of)):
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
    columns: I64,
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
            for i in range(D):
                row = columns[o, i]
                if row < 0:
                    continue
                g[row] += w * (J[0, i] * r[0] + J[1, i] * r[1])
                for j in range(3):
                    W[o, i, j] = w * (J[0, i] * Jp[0, j] + J[1, i] * Jp[1, j])
                for j in range(D):
                    column = columns[o, j]
                    if column >= 0:
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


@njit(cache=True, nogil=True, fastmath={"contract"})
def _schur(V: F64, gp: F64, W: F64, starts: I64, columns: I64, size: int, damping: float) -> tuple[F64, F64]:
    """Schur complement: the terms that eliminating the points subtracts from H and g."""
    n, S, most = len(starts) - 1, columns.shape[1] - 6, 0
    half = np.zeros((size, size))  # of pairs of observations, each once: H is this plus its transpose
    g = np.zeros(size)
    for p in range(n):
        most = max(most, starts[p + 1] - starts[p])
    # of a point's observations by free cameras: W inverse(V), the transpose of W, and the camera's first column
    left, right, column = np.empty((most, 6, 3)), np.empty((most, 3, 6)), np.empty(most, np.int64)
    inverse, shared, weighted = np.empty((3, 3)), np.empty((S, 3)), np.empty((S, 3))
    for p in range(n):
        _inverse3(V[p], damping, inverse)
        m = 0
        shared[:] = 0.0  # sum of W of the shared parameters
        for o in range(starts[p], starts[p + 1]):
            for s in range(S):
                for k in range(3):
                    shared[s, k] += W[o, 6 + s, k]
            if columns[o, 0] < 0:  # a fixed camera has no columns
                continue
            column[m] = columns[o, 0]
            for i in range(6):
                x, y, z, product = W[o, i, 0], W[o, i, 1], W[o, i, 2], 0.0
                right[m, 0, i], right[m, 1, i], right[m, 2, i] = x, y, z
                for j in range(3):
                    left[m, i, j] = x * inverse[0, j] + y * inverse[1, j] + z * inverse[2, j]
                    product += left[m, i, j] * gp[p, j]
                g[column[m] + i] += product
            m += 1
        for a in range(m):
            for o in range(a, m):
                weight = 0.5 if o == a else 1.0
                X, Y, Z = right[o, 0], right[o, 1], right[o, 2]
                for i in range(6):
                    row = half[column[a] + i, column[o] : column[o] + 6]
                    x, y, z = weight * left[a, i, 0], weight * left[a, i, 1], weight * left[a, i, 2]
                    for j in range(6):
                        row[j] += x * X[j] + y * Y[j] + z * Z[j]
            for i in range(6):
                for s in range(S):
                    for k in range(3):
                        half[column[a] + i, size - S + s] += left[a, i, k] * shared[s, k]
        for s in range(S):
            weighted[s] = 0.0
            for j in range(3):
                for k in range(3):
                    weighted[s, j] += shared[s, k] * inverse[k, j]
                g[size - S + s] += weighted[s, j] * gp[p, j]
            for t in range(S):
                for k in range(3):
                    half[size - S + s, size - S + t] += 0.5 * weighted[s, k] * shared[t, k]
    return half + half.T, g


@njit(cache=True, nogil=True)
def _back_substitute(step: F64, V: F64, gp: F64, W: F64, starts: I64, columns: I64, damping: float) -> F64:
    """(P, 3) update of the points from that of the cameras."""
    n, D = len(starts) - 1, columns.shape[1]
    out = np.zeros((n, 3))
    for p in range(n):
        inverse = np.empty((3, 3))
        right = np.empty(3)
        for j in range(3):
            right[j] = gp[p, j]
        for o in range(starts[p], starts[p + 1]):
            for i in range(D):
                row = columns[o, i]
                if row >= 0:
                    for j in range(3):
                        right[j] += W[o, i, j] * step[row]
        _inverse3(V[p], damping, inverse)
        for i in range(3):
            out[p, i] = -(inverse[i, 0] * right[0] + inverse[i, 1] * right[1] + inverse[i, 2] * right[2])
    return out
