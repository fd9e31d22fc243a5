"""Bundle adjustment of photo poses and lenses on a known surface.

Each point seen by several photos may slide along the surface, as its position there is uncertain, but leaves the
surface only within the accuracy of the surface: this ties the photos to the cloud. Unknowns are one correction per
camera (in its own axes: the error of its calibration to the vehicle), the focal length and radial distortion of its
lens, and one correction per photo (in local axes: the error of the path), which drifts along the path as an
Ornstein-Uhlenbeck process: neighbouring photos share slow errors, and a photo without points is interpolated between
the photos before and after it. What neither photos nor surface determine (a shift along a straight road between walls
and ground) is held by the priors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from scan2sim.pipeline.camera.lens import LENS_MODELS, changed_lens
from scan2sim.pipeline.camera.models import project, project_exactly, unproject
from scan2sim.pipeline.core.types import F64, I64, Camera
from scan2sim.pipeline.geometry.least_squares import block_diagonal, block_jacobian, cauchy_weights, skew
from scan2sim.texturing.pose_refinement.matches import Matches

CAUCHY_SCALE_PX = 1.0
"""Residual in compared pixels beyond which an observation is down-weighted (Cauchy); at least twice the median."""
OBSERVATION_SIGMA_PX = 0.5
"""Standard deviation of an observation in compared pixels, from matching and from the surface."""
SURFACE_NORMAL_SIGMA_M, SURFACE_TANGENT_SIGMA_M = 0.02, 0.5
"""Standard deviations in metres by which a point may leave the surface (scanner noise) and slide along it."""
LENS_PARAMETERS = (0, 3, 4)
"""Estimated lens parameters, of those of `pipeline.camera.lens.GIVEN_SIGMA`: focal length, k1, k2. A shift of the
principal point resembles a rotation of the camera."""
LENS_DIFFERENCE = 1e-5
"""Difference of lens parameters for numerical derivatives."""
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
        lens: (5,) lens parameters of a camera, as in `pipeline.camera.lens.GIVEN_SIGMA`; 0: those of the given lens.
    """

    shift: float
    turn: float
    camera_shift: float
    camera_turn: float
    correlation_length: float
    lens: F64


@dataclass(frozen=True)
class Corrections:
    """Corrections of poses and lenses.

    Attributes:
        photo: (V, 6) rotation vector (rad) and shift (m) in local axes, about each photo's centre.
        camera: (C, 6) the same in the camera's axes.
        lens: (C, 5) changes of the camera's lens parameters, see `pipeline.camera.lens.changed_lens`.
    """

    photo: F64
    camera: F64
    lens: F64

    @classmethod
    def none(cls, photos: int, cameras: int) -> Corrections:
        """No correction."""
        return cls(np.zeros((photos, 6)), np.zeros((cameras, 6)), np.zeros((cameras, 5)))

    def lenses(self, given: Sequence[Camera], camera: I64) -> list[Camera]:
        """Cameras of all views with corrected lenses; `camera` (V,) is the index of each view's camera."""
        return [changed_lens(one, by) if by.any() else one for one, by in zip(given, self.lens[camera], strict=True)]

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
        cameras: given camera of each view, at the compared size.
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
    for _ in range(MAX_ITERATIONS):
        at = now.apply(poses, camera)
        residual, by_point, by_pose, by_lens = _linearised(observed, point, now.lenses(cameras, camera), at)
        error = np.linalg.norm(residual, axis=1)
        matched = error[: len(found.point_index)]
        scale = max(CAUCHY_SCALE_PX, 2 * float(np.median(matched))) if len(found.point_index) else CAUCHY_SCALE_PX
        root = np.sqrt(cauchy_weights(residual, scale**2))[:, None] / OBSERVATION_SIGMA_PX
        r = (residual * root).ravel()
        J = block_jacobian((by_point * root[..., None])[:, None], observed.point_index[:, None], len(point))
        pose_part = block_jacobian((by_pose * root[..., None])[:, None], observed.view[:, None], count)
        by_lens = by_lens * root[..., None] * (priors.lens > 0)
        lens_part = block_jacobian(by_lens[:, None], camera[observed.view][:, None], camera_count)
        K = sp.hstack([pose_part, lens_part], format="csr")
        # Schur complement: eliminates the points, whose normal matrix consists of (3, 3) blocks
        inverse = block_diagonal(np.linalg.inv((J.T @ J + stiffness).data))
        right = J.T @ r - stiffness @ (point - found.point).ravel()
        coupling = J.T @ K
        back = coupling.T @ inverse
        corrections = sp.block_diag([_correction_jacobian(at, camera, camera_count), sp.eye_array(5 * camera_count)])
        normal = corrections.T @ (K.T @ K - back @ coupling) @ corrections + precision
        z = np.concatenate([now.photo.ravel(), now.camera.ravel(), now.lens.ravel()])
        step = spsolve(normal.tocsc(), corrections.T @ (K.T @ r - back @ right) - precision @ z)
        point = point + (inverse @ (right - coupling @ (corrections @ step))).reshape(-1, 3)
        z += step
        photo, mounting, lens = np.split(z, [6 * count, 6 * (count + camera_count)])
        now = Corrections(photo.reshape(-1, 6), mounting.reshape(-1, 6), lens.reshape(-1, 5))
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


def _stiffness(normal: F64) -> Any:
    """Sparse (3 P, 3 P) inverse covariance of points: tight along the surface normal, loose along the surface."""
    across = np.einsum("pi,pj->pij", normal, normal)
    along = np.eye(3) - across
    return block_diagonal(across / SURFACE_NORMAL_SIGMA_M**2 + along / SURFACE_TANGENT_SIGMA_M**2)


def _linearised(found: Matches, point: F64, cameras: Sequence[Camera], poses: F64) -> tuple[F64, F64, F64, F64]:
    """Residuals (N, 2), measured minus predicted, and Jacobians of the prediction.

    Jacobians: by point (N, 2, 3), by pose (N, 2, 6), by lens (N, 2, 5), the latter zero for parameters other than
    `LENS_PARAMETERS` and models other than `LENS_MODELS`.
    """
    n = len(found.point_index)
    residual, by_point, by_pose, by_lens = (np.zeros((n, 2, *size)) for size in ((), (3,), (6,), (5,)))
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
        for k in LENS_PARAMETERS if cameras[j].model in LENS_MODELS else ():
            change = LENS_DIFFERENCE * np.eye(5)[k]
            ahead, ok_a = project_exactly(changed_lens(cameras[j], change), x)
            behind, ok_b = project_exactly(changed_lens(cameras[j], -change), x)
            by_lens[rows, :, k] = (ahead - behind) / (2 * LENS_DIFFERENCE)
            valid &= ok_a & ok_b
        J[~valid] = 0
        by_lens[rows[~valid]] = 0
        residual[rows] = np.where(valid[:, None], found.uv[rows] - uv, 0)
        by_point[rows] = J @ R.T
        by_pose[rows, :, :3] = by_point[rows] @ skew(from_)
        by_pose[rows, :, 3:] = -by_point[rows]
    return residual, by_point, by_pose, by_lens


def _correction_jacobian(poses: F64, camera: I64, camera_count: int) -> Any:
    """Sparse (6 V, 6 V + 6 C) Jacobian of the poses by the corrections of photos and cameras."""
    n = len(poses)
    blocks = np.zeros((n, 2, 6, 6))
    blocks[:, 0] = np.eye(6)
    blocks[:, 1, :3, :3] = blocks[:, 1, 3:, 3:] = poses[:, :3, :3]
    return block_jacobian(blocks, np.stack([np.arange(n), n + camera], axis=1), n + camera_count)


def _prior(centres: F64, order: I64, camera_count: int, priors: Priors) -> Any:
    """Sparse (6 V + 11 C, 6 V + 11 C) precision of the corrections; their prior mean is zero."""
    import scipy.sparse as sp

    n = len(centres)
    distance = np.linalg.norm(np.diff(centres[order], axis=0), axis=1)
    length = priors.correlation_length
    correlation = np.exp(-np.maximum(distance, 0.01 * length) / length)
    innovation = np.stack([-correlation, np.ones(n - 1)], axis=1) / np.sqrt(1 - correlation**2)[:, None]
    J = block_jacobian(innovation[:, :, None, None], np.stack([order[:-1], order[1:]], axis=1), n)
    walk = J.T @ J + sp.coo_array(([1.0], ([order[0]], [order[0]])), (n, n))
    own = np.diag([1 / priors.turn**2] * 3 + [1 / priors.shift**2] * 3)
    camera = np.diag([1 / priors.camera_turn**2] * 3 + [1 / priors.camera_shift**2] * 3)
    lens = np.diag(1 / np.where(priors.lens > 0, priors.lens, 1.0) ** 2)
    cameras = sp.eye_array(camera_count)
    return sp.block_diag([sp.kron(walk, own), sp.kron(cameras, camera), sp.kron(cameras, lens)]).tocsc()
