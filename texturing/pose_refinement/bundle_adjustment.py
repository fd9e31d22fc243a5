"""Poses of photos by bundle adjustment on a known surface. Import late: loads numba.

Each place that several photos show may slide along the surface, as nobody knows where on it the corner is, but
leaves it by no more than the surface is unsure by: so the cloud holds the photos. Unknown are one correction a camera
(in its axes: what its calibration to the vehicle lacks) and one a photo (in local axes: what the path lacks), which
wanders along the drive (Ornstein and Uhlenbeck's process): neighbours share what is slow, and a photo without
places takes what those before and after it have. What neither photos nor surface tell (a shift along a
straight road, between walls and ground) stays where it was: priors hold it.
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

OUTLIER = 1.0
"""Pixels (of the compared size) beyond which an observation's say falls (Cauchy); twice the median if that is more."""
SIGMA = 0.5
"""Pixels: standard deviation of an observation: a match's own, and the surface's part in it."""
ON_SURFACE, ALONG_SURFACE = 0.02, 0.5
"""Metres by which a place may leave the surface (the scanner's noise) and slide along it."""
ROUNDS = 8
SETTLED = 1e-4
"""Metres and radians of a step below which it is done."""


@dataclass(frozen=True)
class Priors:
    """By how much poses are expected to be wrong: standard deviations.

    Attributes:
        shift, turn: metres and radians of a photo.
        camera_shift, camera_turn: of a camera against the vehicle.
        wander: metres of the path over which a photo's error becomes another one.
    """

    shift: float
    turn: float
    camera_shift: float
    camera_turn: float
    wander: float


@dataclass(frozen=True)
class Corrections:
    """What poses lack.

    Attributes:
        photo: (V, 6) turn (rotation vector, rad) and shift (m) in local axes, about each photo's centre.
        camera: (C, 6) the same in the camera's axes.
    """

    photo: F64
    camera: F64

    def apply(self, poses: F64, camera: I64) -> F64:
        """(V, 4, 4) the poses corrected; `camera` (V,) names each photo's."""
        from scipy.spatial.transform import Rotation

        out = poses.copy()
        own, lens = self.photo, self.camera[camera]
        turned = Rotation.from_rotvec(own[:, :3]).as_matrix() @ poses[:, :3, :3]
        out[:, :3, :3] = turned @ Rotation.from_rotvec(lens[:, :3]).as_matrix()
        out[:, :3, 3] = poses[:, :3, 3] + own[:, 3:] + np.einsum("nij,nj->ni", turned, lens[:, 3:])
        return out


def chain(centres: F64, times: Sequence[float | None]) -> I64:
    """(V,) views in the order in which they were taken; as they are listed where that isn't known."""
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
    """The corrections that bring matches together.

    Args:
        found: places and what shows them; its places and matches were told with `start` applied.
        cameras: of each view, of the compared size.
        poses: (V, 4, 4) as they were given.
        start: corrections so far; priors are about none.
        camera: (V,) index of each view's camera.
        order: (V,) views as they were taken.
        priors: see there.
    """
    import scipy.sparse as sp
    from scipy.sparse.linalg import spsolve

    count, lenses = len(poses), len(start.camera)
    whole = _with_first(found)
    place, now = found.place.copy(), start
    stiff = _stiffness(found.normal)
    held = _prior(poses[:, :3, 3], order, lenses, priors)
    pairs, block = _pairs(whole, count)
    for _ in range(ROUNDS):
        at = now.apply(poses, camera)
        residual, by_place, by_pose = _linearised(whole, place, cameras, at)
        off = np.linalg.norm(residual, axis=1)
        loose = max(OUTLIER, 2 * float(np.median(off[: len(found.of)]))) if len(found.of) else OUTLIER
        weight = 1 / (1 + (off / loose) ** 2) / SIGMA**2
        S, g, Hinv, e, cross = _reduced(
            residual, by_place, by_pose, weight, whole.of, whole.view, stiff, place - found.place, pairs, block, count
        )
        rows = np.repeat(np.repeat(pairs[:, 0, None, None] * 6, 6, 1), 6, 2) + np.arange(6)[None, :, None]
        columns = np.repeat(np.repeat(pairs[:, 1, None, None] * 6, 6, 1), 6, 2) + np.arange(6)[None, None, :]
        normal = sp.csc_array((S.ravel(), (rows.ravel(), columns.ravel())), (6 * count, 6 * count))
        shares = _shares(at, camera, lenses)
        z = np.concatenate([now.photo.ravel(), now.camera.ravel()])
        step = spsolve((shares.T @ normal @ shares + held).tocsc(), shares.T @ g - held @ z)
        moved = (shares @ step).reshape(-1, 6)
        place = place + _places_moved(moved, Hinv, e, cross, whole.of, whole.view)
        z += step
        now = Corrections(z[: 6 * count].reshape(-1, 6), z[6 * count :].reshape(-1, 6))
        if np.abs(step).max() < SETTLED:
            break
    return now


def displacement(found: Matches, cameras: Sequence[Camera], poses: F64) -> F64:
    """(N,) pixels between where matches are and where the first photo, at these poses, has them on the surface."""
    ray = np.zeros((len(found.place), 3))
    for i in np.unique(found.first):
        mine = found.first == i
        ray[mine] = unproject(cameras[i], found.corner[mine]) @ poses[i, :3, :3].T
    from_ = poses[found.first, :3, 3]
    along = np.einsum("ij,ij->i", ray, found.normal)
    far = np.einsum("ij,ij->i", found.place - from_, found.normal) / np.where(np.abs(along) > 1e-6, along, np.nan)
    place = (from_ + ray * far[:, None])[found.of]
    off = np.full(len(found.of), np.nan)
    for j in np.unique(found.view):
        theirs = np.flatnonzero(found.view == j)
        # not by `projection.pixels`, whose pixels are float32
        uv, ok = project(cameras[j], (place[theirs] - poses[j, :3, 3]) @ poses[j, :3, :3])
        off[theirs[ok]] = np.linalg.norm(uv[ok] - found.uv[theirs[ok]], axis=1)
    return off


def _with_first(found: Matches) -> Matches:
    """The corners themselves as observations, after the others."""
    some = np.unique(found.of)
    return replace(
        found,
        of=np.concatenate([found.of, some]),
        view=np.concatenate([found.view, found.first[some]]),
        uv=np.concatenate([found.uv, found.corner[some]]),
    )


def _stiffness(normal: F64) -> F64:
    """(P, 3, 3) inverse covariance of places: free along the surface, bound to it."""
    across = np.einsum("pi,pj->pij", normal, normal)
    along = np.eye(3) - across
    return across / ON_SURFACE**2 + along / ALONG_SURFACE**2


def _linearised(found: Matches, place: F64, cameras: Sequence[Camera], poses: F64) -> tuple[F64, F64, F64]:
    """Residuals (N, 2), measured less told, and derivatives of what is told: by place (N, 2, 3), by pose (N, 2, 6)."""
    n = len(found.of)
    residual, by_place, by_pose = np.zeros((n, 2)), np.zeros((n, 2, 3)), np.zeros((n, 2, 6))
    for j in np.unique(found.view):
        rows = np.flatnonzero(found.view == j)
        R, from_ = poses[j, :3, :3], place[found.of[rows]] - poses[j, :3, 3]
        x = from_ @ R
        uv, valid = project_exactly(cameras[j], x)
        J = np.zeros((len(rows), 2, 3))
        step = 1e-4 * np.linalg.norm(x, axis=1)
        for k in range(3):  # whatever the camera's model
            d = np.zeros_like(x)
            d[:, k] = step
            ahead, ok_a = project_exactly(cameras[j], x + d)
            behind, ok_b = project_exactly(cameras[j], x - d)
            J[:, :, k] = (ahead - behind) / (2 * step[:, None])
            valid &= ok_a & ok_b
        J[~valid] = 0
        residual[rows] = np.where(valid[:, None], found.uv[rows] - uv, 0)
        by_place[rows] = J @ R.T
        turning = np.zeros((len(rows), 3, 3))  # R^T [from x]
        turning[:, 0, 1], turning[:, 0, 2] = -from_[:, 2], from_[:, 1]
        turning[:, 1, 0], turning[:, 1, 2] = from_[:, 2], -from_[:, 0]
        turning[:, 2, 0], turning[:, 2, 1] = -from_[:, 1], from_[:, 0]
        by_pose[rows, :, :3] = by_place[rows] @ turning
        by_pose[rows, :, 3:] = -by_place[rows]
    return residual, by_place, by_pose


def _pairs(found: Matches, count: int) -> tuple[I64, I32]:
    """(B, 2) pairs of views that share a place, and (V, V) the index of each pair; -1 for none."""
    order = np.argsort(found.of, kind="stable")
    start = np.searchsorted(found.of[order], np.arange(len(found.place) + 1))
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
    residual: F64, by_place: F64, by_pose: F64, weight: F64, of: I64, view: I64,
    stiff: F64, left: F64, pairs: I64, block: I32, count: int,
) -> tuple[F64, F64, F64, F64, F64]:  # fmt: skip
    """Normal equations of the poses with the places eliminated (Schur).

    Returns:
        (B, 6, 6) blocks and (V * 6,) right side; and what brings the places back: (P, 3, 3) inverses, (P, 3) right
        sides, (N, 3, 6) products of an observation's derivatives.
    """
    H = stiff.copy()
    e = -np.einsum("pij,pj->pi", stiff, left)
    np.add.at(H, of, np.einsum("n,nri,nrj->nij", weight, by_place, by_place))
    np.add.at(e, of, np.einsum("n,nri,nr->ni", weight, by_place, residual))
    Hinv = np.linalg.inv(H).astype(np.float64)
    cross: F64 = np.einsum("n,nri,nrj->nij", weight, by_place, by_pose).astype(np.float64)
    S, g = np.zeros((len(pairs), 6, 6)), np.zeros((count, 6))
    np.add.at(S, block[view, view], np.einsum("n,nri,nrj->nij", weight, by_pose, by_pose))
    np.add.at(g, view, np.einsum("n,nri,nr->ni", weight, by_pose, residual))
    order = np.argsort(of, kind="stable")
    start = np.searchsorted(of[order], np.arange(len(stiff) + 1))
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


def _places_moved(moved: F64, Hinv: F64, e: F64, cross: F64, of: I64, view: I64) -> F64:
    """(P, 3) what places move by, once the poses' steps (V, 6) are known."""
    right = e.copy()
    np.add.at(right, of, -np.einsum("nij,nj->ni", cross, moved[view]))
    return np.einsum("pij,pj->pi", Hinv, right)


def _shares(poses: F64, camera: I64, lenses: int) -> Any:
    """Sparse (6 V, 6 V + 6 C): the step of each pose from photos' and cameras' corrections."""
    import scipy.sparse as sp

    n = len(poses)
    r = 6 * np.arange(n)[:, None, None] + np.arange(3)[None, :, None]
    c = 6 * (n + camera)[:, None, None] + np.arange(3)[None, None, :]
    r, c = np.broadcast_arrays(r, c)
    R = poses[:, :3, :3]
    rows = np.concatenate([np.arange(6 * n), r.ravel(), r.ravel() + 3])
    columns = np.concatenate([np.arange(6 * n), c.ravel(), c.ravel() + 3])
    values = np.concatenate([np.ones(6 * n), R.ravel(), R.ravel()])
    return sp.csc_array((values, (rows, columns)), (6 * n, 6 * (n + lenses)))


def _prior(centres: F64, order: I64, lenses: int, priors: Priors) -> Any:
    """Sparse (6 V + 6 C) squared: precision of the corrections, about none."""
    import scipy.sparse as sp

    n = len(centres)
    far = np.linalg.norm(np.diff(centres[order], axis=0), axis=1)
    alike = np.exp(-np.maximum(far, 0.01 * priors.wander) / priors.wander)
    tight = 1 / (1 - alike**2)
    first, then = order[:-1], order[1:]
    diagonal = np.zeros(n)
    diagonal[order[0]] += 1
    np.add.at(diagonal, then, tight)
    np.add.at(diagonal, first, alike**2 * tight)
    apart = -alike * tight
    rows, columns = np.concatenate([np.arange(n), first, then]), np.concatenate([np.arange(n), then, first])
    walk = sp.coo_array((np.concatenate([diagonal, apart, apart]), (rows, columns)), (n, n))
    own = np.diag([1 / priors.turn**2] * 3 + [1 / priors.shift**2] * 3)
    lens = np.diag([1 / priors.camera_turn**2] * 3 + [1 / priors.camera_shift**2] * 3)
    return sp.block_diag([sp.kron(walk, own), sp.kron(sp.eye_array(lenses), lens)]).tocsc()
