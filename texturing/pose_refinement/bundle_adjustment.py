"""Bundle adjustment of photo poses on a known surface. Import late: loads numba.

Each point seen by several photos may slide along the surface, as its position there is uncertain, but leaves the
surface only within the accuracy of the surface: this ties the photos to the cloud. Unknowns are one correction per
camera (in its own axes: the error of its calibration to the vehicle) and one per photo (in local axes: the error of the
path), which drifts along the path as an Ornstein-Uhlenbeck process: neighbouring photos share slow errors, and a photo
without points is interpolated between the photos before and after it. What neither photos nor surface determine (a
shift along a straight road between walls and ground) is held by the priors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numba import njit

from scan2sim.pipeline.camera.models import project, project_exactly, unproject
from scan2sim.pipeline.core.types import F64, I32, I64, Camera
from scan2sim.texturing.pose_refinement.matches import Matches

CAUCHY_SCALE_PX = 1.0
"""Residual in compared pixels beyond which an observation is down-weighted (Cauchy); at least twice the median."""
OBSERVATION_SIGMA_PX = 0.5
"""Standard deviation of an observation in compared pixels, from matching and from the surface."""
SURFACE_NORMAL_SIGMA_M, SURFACE_TANGENT_SIGMA_M = 0.02, 0.5
"""Standard deviations in metres by which a point may leave the surface (scanner noise) and slide along it."""
MAX_ITERATIONS = 8
CONVERGED_STEP = 1e-4
"""Step in metres and radians below which the solution has converged."""


@dataclass(frozen=True)
class Priors:
    """Expected errors of poses: standard deviations.

    Attributes:
        shift, turn: position (metres) and rotation (radians) of a photo.
        camera_shift, camera_turn: position and rotation of a camera relative to the vehicle.
        correlation_length: metres of path over which the error of a photo's pose decorrelates.
    """

    shift: float
    turn: float
    camera_shift: float
    camera_turn: float
    correlation_length: float


@dataclass(frozen=True)
class Corrections:
    """Corrections of poses.

    Attributes:
        photo: (V, 6) rotation vector (rad) and shift (m) in local axes, about each photo's centre.
        camera: (C, 6) the same in the camera's axes.
    """

    photo: F64
    camera: F64

    def apply(self, poses: F64, camera: I64) -> F64:
        """(V, 4, 4) corrected poses; `camera` (V,) is the index of each photo's camera."""
        from scipy.spatial.transform import Rotation

        out = poses.copy()
        own, lens = self.photo, self.camera[camera]
        turned = Rotation.from_rotvec(own[:, :3]).as_matrix() @ poses[:, :3, :3]
        out[:, :3, :3] = turned @ Rotation.from_rotvec(lens[:, :3]).as_matrix()
        out[:, :3, 3] = poses[:, :3, 3] + own[:, 3:] + np.einsum("nij,nj->ni", turned, lens[:, 3:])
        return out


def capture_order(centres: F64, times: Sequence[float | None]) -> I64:
    """(V,) views in the order in which they were taken; in the given order if a time is unknown."""
    known = [t for t in times if t is not None]
    if len(known) < len(times):
        return np.arange(len(centres))
    return np.argsort(np.asarray(known), kind="stable")


def solve(
    found: Matches,
    cameras: Sequence[Camera],
    poses: F64,
    start: Corrections,
    camera: I64,
    order: I64,
    priors: Priors,
) -> Corrections:
    """Corrections that minimise the reprojection errors of the matches.

    Args:
        found: matches, found at the poses corrected by `start`.
        cameras: camera of each view, at the compared size.
        poses: (V, 4, 4) given poses.
        start: corrections so far; the priors' mean is no correction.
        camera: (V,) index of each view's camera.
        order: (V,) views in capture order.
        priors: expected errors of the poses.
    """
    import scipy.sparse as sp
    from scipy.sparse.linalg import spsolve

    count, camera_count = len(poses), len(start.camera)
    observed = _with_reference_observations(found)
    point, now = found.point.copy(), start
    stiffness = _stiffness(found.normal)
    precision = _prior(poses[:, :3, 3], order, camera_count, priors)
    pairs, block = _pairs(observed, count)
    for _ in range(MAX_ITERATIONS):
        at = now.apply(poses, camera)
        residual, by_point, by_pose = _linearised(observed, point, cameras, at)
        error = np.linalg.norm(residual, axis=1)
        matched = error[: len(found.point_index)]
        scale = max(CAUCHY_SCALE_PX, 2 * float(np.median(matched))) if len(found.point_index) else CAUCHY_SCALE_PX
        weight = 1 / (1 + (error / scale) ** 2) / OBSERVATION_SIGMA_PX**2
        S, g, Hinv, e, cross = _reduced(
            residual, by_point, by_pose, weight, observed.point_index, observed.view, stiffness, point - found.point,
            pairs, block, count,
        )  # fmt: skip
        rows = np.repeat(np.repeat(pairs[:, 0, None, None] * 6, 6, 1), 6, 2) + np.arange(6)[None, :, None]
        columns = np.repeat(np.repeat(pairs[:, 1, None, None] * 6, 6, 1), 6, 2) + np.arange(6)[None, None, :]
        normal = sp.csc_array((S.ravel(), (rows.ravel(), columns.ravel())), (6 * count, 6 * count))
        jacobian = _correction_jacobian(at, camera, camera_count)
        z = np.concatenate([now.photo.ravel(), now.camera.ravel()])
        step = spsolve((jacobian.T @ normal @ jacobian + precision).tocsc(), jacobian.T @ g - precision @ z)
        pose_step = (jacobian @ step).reshape(-1, 6)
        point = point + _point_steps(pose_step, Hinv, e, cross, observed.point_index, observed.view)
        z += step
        now = Corrections(z[: 6 * count].reshape(-1, 6), z[6 * count :].reshape(-1, 6))
        if np.abs(step).max() < CONVERGED_STEP:
            break
    return now


def displacement(found: Matches, cameras: Sequence[Camera], poses: F64) -> F64:
    """(N,) pixels between each match and the projection of the first photo's corner via the surface, at `poses`."""
    ray = np.zeros((len(found.point), 3))
    for i in np.unique(found.first):
        own = found.first == i
        ray[own] = unproject(cameras[i], found.corner[own]) @ poses[i, :3, :3].T
    from_ = poses[found.first, :3, 3]
    along = np.einsum("ij,ij->i", ray, found.normal)
    far = np.einsum("ij,ij->i", found.point - from_, found.normal) / np.where(np.abs(along) > 1e-6, along, np.nan)
    point = (from_ + ray * far[:, None])[found.point_index]
    error = np.full(len(found.point_index), np.nan)
    for j in np.unique(found.view):
        rows = np.flatnonzero(found.view == j)
        # not by `projection.pixels`, whose pixels are float32
        uv, ok = project(cameras[j], (point[rows] - poses[j, :3, 3]) @ poses[j, :3, :3])
        error[rows[ok]] = np.linalg.norm(uv[ok] - found.uv[rows[ok]], axis=1)
    return error


def _with_reference_observations(found: Matches) -> Matches:
    """Matches with the corners in their first photos as additional observations, after the others."""
    matched = np.unique(found.point_index)
    return replace(
        found,
        point_index=np.concatenate([found.point_index, matched]),
        view=np.concatenate([found.view, found.first[matched]]),
        uv=np.concatenate([found.uv, found.corner[matched]]),
    )


def _stiffness(normal: F64) -> F64:
    """(P, 3, 3) inverse covariance of points: tight along the surface normal, loose along the surface."""
    across = np.einsum("pi,pj->pij", normal, normal)
    along = np.eye(3) - across
    return across / SURFACE_NORMAL_SIGMA_M**2 + along / SURFACE_TANGENT_SIGMA_M**2


def _linearised(found: Matches, point: F64, cameras: Sequence[Camera], poses: F64) -> tuple[F64, F64, F64]:
    """Residuals (N, 2), measured minus predicted; Jacobians of the prediction by point (N, 2, 3), by pose (N, 2, 6)."""
    n = len(found.point_index)
    residual, by_point, by_pose = np.zeros((n, 2)), np.zeros((n, 2, 3)), np.zeros((n, 2, 6))
    for j in np.unique(found.view):
        rows = np.flatnonzero(found.view == j)
        R, from_ = poses[j, :3, :3], point[found.point_index[rows]] - poses[j, :3, 3]
        x = from_ @ R
        uv, valid = project_exactly(cameras[j], x)
        J = np.zeros((len(rows), 2, 3))
        step = 1e-4 * np.linalg.norm(x, axis=1)
        for k in range(3):  # numerical differentiation works for every camera model
            d = np.zeros_like(x)
            d[:, k] = step
            ahead, ok_a = project_exactly(cameras[j], x + d)
            behind, ok_b = project_exactly(cameras[j], x - d)
            J[:, :, k] = (ahead - behind) / (2 * step[:, None])
            valid &= ok_a & ok_b
        J[~valid] = 0
        residual[rows] = np.where(valid[:, None], found.uv[rows] - uv, 0)
        by_point[rows] = J @ R.T
        cross_matrix = np.zeros((len(rows), 3, 3))  # skew-symmetric matrix of from_
        cross_matrix[:, 0, 1], cross_matrix[:, 0, 2] = -from_[:, 2], from_[:, 1]
        cross_matrix[:, 1, 0], cross_matrix[:, 1, 2] = from_[:, 2], -from_[:, 0]
        cross_matrix[:, 2, 0], cross_matrix[:, 2, 1] = -from_[:, 1], from_[:, 0]
        by_pose[rows, :, :3] = by_point[rows] @ cross_matrix
        by_pose[rows, :, 3:] = -by_point[rows]
    return residual, by_point, by_pose


def _pairs(found: Matches, count: int) -> tuple[I64, I32]:
    """(B, 2) pairs of views that share a point, and (V, V) index of each pair; -1 for none."""
    order = np.argsort(found.point_index, kind="stable")
    start = np.searchsorted(found.point_index[order], np.arange(len(found.point) + 1))
    block = np.full((count, count), -1, np.int32)
    _mark(block, found.view[order], start)
    pairs = np.argwhere(block >= 0)
    block[pairs[:, 0], pairs[:, 1]] = np.arange(len(pairs))
    return pairs, block


@njit(cache=True)
def _mark(block: I32, view: I64, start: I64) -> None:
    for p in range(len(start) - 1):
        for i in range(start[p], start[p + 1]):
            for j in range(start[p], start[p + 1]):
                block[view[i], view[j]] = 0


def _reduced(
    residual: F64, by_point: F64, by_pose: F64, weight: F64, point_index: I64, view: I64,
    stiffness: F64, point_offset: F64, pairs: I64, block: I32, count: int,
) -> tuple[F64, F64, F64, F64, F64]:  # fmt: skip
    """Reduced normal equations of the poses, with the points eliminated (Schur complement).

    Returns:
        (B, 6, 6) blocks and (V * 6,) right-hand side; and for the back substitution of the points: (P, 3, 3) inverses,
        (P, 3) right-hand sides, (N, 3, 6) products of each observation's Jacobians.
    """
    H = stiffness.copy()
    e = -np.einsum("pij,pj->pi", stiffness, point_offset)
    np.add.at(H, point_index, np.einsum("n,nri,nrj->nij", weight, by_point, by_point))
    np.add.at(e, point_index, np.einsum("n,nri,nr->ni", weight, by_point, residual))
    Hinv = np.linalg.inv(H).astype(np.float64)
    cross: F64 = np.einsum("n,nri,nrj->nij", weight, by_point, by_pose).astype(np.float64)
    S, g = np.zeros((len(pairs), 6, 6)), np.zeros((count, 6))
    np.add.at(S, block[view, view], np.einsum("n,nri,nrj->nij", weight, by_pose, by_pose))
    np.add.at(g, view, np.einsum("n,nri,nr->ni", weight, by_pose, residual))
    order = np.argsort(point_index, kind="stable")
    start = np.searchsorted(point_index[order], np.arange(len(stiffness) + 1))
    _eliminate(S, g, Hinv, e, cross, order, view, start, block)
    return S, g.ravel(), Hinv, e, cross


@njit(cache=True)
def _eliminate(S: F64, g: F64, Hinv: F64, e: F64, cross: F64, order: I64, view: I64, start: I64, block: I32) -> None:
    for p in range(len(start) - 1):
        for a in range(start[p], start[p + 1]):
            i = order[a]
            back = cross[i].T @ Hinv[p]
            g[view[i]] -= back @ e[p]
            for b in range(start[p], start[p + 1]):
                j = order[b]
                S[block[view[i], view[j]]] -= back @ cross[j]


def _point_steps(pose_step: F64, Hinv: F64, e: F64, cross: F64, point_index: I64, view: I64) -> F64:
    """(P, 3) steps of the points by back substitution of the poses' steps (V, 6)."""
    right = e.copy()
    np.add.at(right, point_index, -np.einsum("nij,nj->ni", cross, pose_step[view]))
    return np.einsum("pij,pj->pi", Hinv, right)


def _correction_jacobian(poses: F64, camera: I64, camera_count: int) -> Any:
    """Sparse (6 V, 6 V + 6 C) Jacobian of the poses by the corrections of photos and cameras."""
    import scipy.sparse as sp

    n = len(poses)
    r = 6 * np.arange(n)[:, None, None] + np.arange(3)[None, :, None]
    c = 6 * (n + camera)[:, None, None] + np.arange(3)[None, None, :]
    r, c = np.broadcast_arrays(r, c)
    R = poses[:, :3, :3]
    rows = np.concatenate([np.arange(6 * n), r.ravel(), r.ravel() + 3])
    columns = np.concatenate([np.arange(6 * n), c.ravel(), c.ravel() + 3])
    values = np.concatenate([np.ones(6 * n), R.ravel(), R.ravel()])
    return sp.csc_array((values, (rows, columns)), (6 * n, 6 * (n + camera_count)))


def _prior(centres: F64, order: I64, camera_count: int, priors: Priors) -> Any:
    """Sparse (6 V + 6 C, 6 V + 6 C) precision of the corrections; their prior mean is zero."""
    import scipy.sparse as sp

    n = len(centres)
    distance = np.linalg.norm(np.diff(centres[order], axis=0), axis=1)
    length = priors.correlation_length
    correlation = np.exp(-np.maximum(distance, 0.01 * length) / length)
    innovation_precision = 1 / (1 - correlation**2)
    first, then = order[:-1], order[1:]
    diagonal = np.zeros(n)
    diagonal[order[0]] += 1
    np.add.at(diagonal, then, innovation_precision)
    np.add.at(diagonal, first, correlation**2 * innovation_precision)
    off_diagonal = -correlation * innovation_precision
    rows, columns = np.concatenate([np.arange(n), first, then]), np.concatenate([np.arange(n), then, first])
    walk = sp.coo_array((np.concatenate([diagonal, off_diagonal, off_diagonal]), (rows, columns)), (n, n))
    own = np.diag([1 / priors.turn**2] * 3 + [1 / priors.shift**2] * 3)
    camera = np.diag([1 / priors.camera_turn**2] * 3 + [1 / priors.camera_shift**2] * 3)
    return sp.block_diag([sp.kron(walk, own), sp.kron(sp.eye_array(camera_count), camera)]).tocsc()
