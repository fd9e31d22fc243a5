"""Planes of a cloud: grown from where it is flat, fitted robustly. Import late: it loads numba.

Rabbani et al., "Segmentation of point clouds using smoothness constraint", ISPRS 2006.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit, prange
from scipy.spatial import cKDTree

from scan2sim.pipeline.core.types import F32, F64, I32

NEIGHBOURS = 12
REACH = 2.6
"""Voxels within which points are neighbours: over one that is missing."""
FLAT_SHARE = 30
"""Percentile of the points' residuals that is the noise of flat surfaces: so much of what was built is flat."""
SIGMAS = 3.0
LEAST, MOST = 0.15, 0.8
"""Voxels that the tolerance is held to, whatever the noise."""
TURN = float(np.cos(np.radians(20.0)))
"""By which normals of one plane may differ: their neighbourhoods reach around corners."""
POINTS = 40
"""A plane's points, at least: .4 m2 at the mission's voxels."""
BENT = float(np.radians(10.0))
"""Turn of a plane's normal from end to end, by a parabola through its points, from which on it is no plane."""
BENT_SAMPLE = 2000
"""Points that tell it."""
SCALE = 100.0
"""Metres by which two planes are told as different as by a radian between their normals."""
ROUNDS = 2
"""Times that planes grow by the points beside them, whose normals are those of a corner."""


@dataclass(frozen=True)
class Planes:
    """Planes `normal . x = offset`.

    Attributes:
        normal: (P, 3) unit, to the outside of what is there.
        offset: (P,) metres.
    """

    normal: F64
    offset: F64

    def __len__(self) -> int:
        return len(self.offset)

    @staticmethod
    def join(parts: Sequence[Planes]) -> Planes:
        """All planes of parts, in order."""
        return Planes(np.concatenate([p.normal for p in parts]), np.concatenate([p.offset for p in parts]))

    def of(self, xyz: F32, normal: F32) -> I32:
        """(N,) the plane that each of places (N, 3) was laid on, by their unit normals (N, 3)."""
        places, facing = xyz.astype(np.float64), normal.astype(np.float64)
        offset = np.einsum("ij,ij->i", places, facing)
        tree = cKDTree(np.column_stack([SCALE * self.normal, self.offset]))
        return np.asarray(tree.query(np.column_stack([SCALE * facing, offset]))[1], np.int32)

    def beyond(self, xyz: npt.NDArray[Any], which: I32) -> F64:
        """(N,) metres from points (N, 3), local coordinates, to planes `which` (N,), positive outside."""
        return np.einsum("ij,ij->i", xyz, self.normal[which]) - self.offset[which]


def detect(xyz: F32, normal: F32, voxel: float) -> tuple[Planes, I32, float]:
    """Planes of a thinned cloud.

    Args:
        xyz: (N, 3) local metres, one a voxel.
        normal: (N, 3) unit, to the outside.
        voxel: metres.

    Returns:
        The planes, each point's (N,), -1 for none; and metres by which points of a plane may miss it: three times the
        noise that flat places have.
    """
    none = np.full(len(xyz), -1, np.int32)
    if len(xyz) < POINTS:
        return Planes(np.zeros((0, 3)), np.zeros(0)), none, LEAST * voxel
    points, normals = xyz.astype(np.float64), normal.astype(np.float64)
    near = cKDTree(xyz).query(xyz, NEIGHBOURS + 1, distance_upper_bound=REACH * voxel, workers=-1)[1].astype(np.int32)
    rough = _residuals(points, normals, near)
    tolerance = float(np.clip(SIGMAS * np.percentile(rough, FLAT_SHARE), LEAST * voxel, MOST * voxel))
    order = np.argsort(rough, kind="stable").astype(np.int32)
    which = _grow(points, normals, near, order[rough[order] <= tolerance], tolerance, TURN, POINTS)
    which = _without_bent(points, which, _fitted(points, normals, which, tolerance))
    planes = _fitted(points, normals, which, tolerance)
    for _ in range(ROUNDS):
        which = _widened(points, near, which, np.ascontiguousarray(planes.normal), planes.offset, tolerance)
    return _fitted(points, normals, which, tolerance), which, tolerance


@njit(cache=True, parallel=True)
def _residuals(xyz: F64, normal: F64, near: I32) -> F64:
    """(N,) root mean square distance of each point's neighbours to the plane through their middle."""
    n = len(xyz)
    out = np.empty(n)
    for i in prange(n):
        count, total, squares = 0, 0.0, 0.0
        for j in near[i]:
            if j < n:
                d = 0.0
                for k in range(3):
                    d += normal[i, k] * (xyz[j, k] - xyz[i, k])
                count, total, squares = count + 1, total + d, squares + d * d
        out[i] = np.sqrt(max(0.0, squares / count - (total / count) ** 2)) if count > 5 else np.inf
    return out


@njit(cache=True, inline="always")
def _along(places: F64, i: int, axis: F64) -> float:
    """Place i (of (N, 3)) along an axis (3,)."""
    return places[i, 0] * axis[0] + places[i, 1] * axis[1] + places[i, 2] * axis[2]


@njit(cache=True)
def _grow(xyz: F64, normal: F64, near: I32, seeds: I32, tolerance: float, turn: float, least: int) -> I32:
    """(N,) regions from each seed in turn: neighbours are added that lie on the plane so far; small ones dissolve."""
    n, found = len(xyz), 0
    which = np.full(n, -1, np.int32)
    members = np.empty(n, np.int32)
    for seed in seeds:
        if which[seed] >= 0:
            continue
        axis, level = normal[seed].copy(), _along(xyz, seed, normal[seed])
        total, outer = np.zeros(3), np.zeros((3, 3))
        count, at, refit = 1, 0, NEIGHBOURS
        members[0] = seed
        which[seed] = found
        while at < count:
            i = members[at]
            at += 1
            for k in range(3):
                x = xyz[i, k] - xyz[seed, k]
                total[k] += x
                for m in range(3):
                    outer[k, m] += x * (xyz[i, m] - xyz[seed, m])
            if at == refit:
                refit = int(1.5 * refit)
                mean = total / at
                vectors = np.linalg.eigh(outer / at - np.outer(mean, mean))[1]
                turned = np.ascontiguousarray(vectors[:, 0])
                axis = turned if np.dot(turned, axis) > 0 else -turned
                level = np.dot(mean + xyz[seed], axis)
            for j in near[i]:
                if j == n or which[j] >= 0 or _along(normal, j, axis) <= turn:
                    continue
                if abs(_along(xyz, j, axis) - level) <= tolerance:
                    which[j] = found
                    members[count] = j
                    count += 1
        if count < least:
            for k in range(count):
                which[members[k]] = -1
        else:
            found += 1
    return which


@njit(cache=True, parallel=True)
def _widened(xyz: F64, near: I32, which: I32, normal: F64, offset: F64, tolerance: float) -> I32:
    """Each point's plane: its own, else that of its neighbours' which it lies on best."""
    n = len(xyz)
    out = which.copy()
    for i in prange(n):
        best, own = tolerance, which[i]
        if own >= 0:
            if abs(_along(xyz, i, normal[own]) - offset[own]) <= tolerance:
                continue
            out[i] = -1
        for j in near[i]:
            if j < n and which[j] >= 0:
                d = abs(_along(xyz, i, normal[which[j]]) - offset[which[j]])
                if d < best:
                    best = d
                    out[i] = which[j]
    return out


def _fitted(xyz: F64, normal: F64, which: I32, tolerance: float) -> Planes:
    """Each region's plane, by least squares with Tukey's weights."""
    count = int(which.max(initial=-1)) + 1
    own = np.flatnonzero(which >= 0)
    plane, places = which[own], xyz[own]
    weight = np.ones(len(own))
    planes = Planes(np.zeros((count, 3)), np.zeros(count))
    outward = _sums(plane, normal[own], count)
    for _ in range(3):
        total = np.maximum(np.bincount(plane, weight, count), 1e-12)
        middle = _sums(plane, places * weight[:, None], count) / total[:, None]
        apart = places - middle[plane]
        outer = np.einsum("ni,nj,n->nij", apart, apart, weight).reshape(-1, 9)
        axis = np.linalg.eigh(_sums(plane, outer, count).reshape(-1, 3, 3))[1][:, :, 0]
        axis = axis * np.where((axis * outward).sum(axis=1) < 0, -1.0, 1.0)[:, None]
        planes = Planes(axis, (axis * middle).sum(axis=1))
        weight = np.maximum(0.0, 1 - (planes.beyond(places, plane) / (1.5 * tolerance)) ** 2) ** 2
    return planes


def _without_bent(xyz: F64, which: I32, planes: Planes) -> I32:
    """The points' planes, numbered anew, without those that are strips of something round."""
    order = np.argsort(which, kind="stable")
    first = np.searchsorted(which[order], np.arange(len(planes) + 1))
    flat = np.ones(len(planes) + 1, bool)
    for p in range(len(planes)):
        members = order[first[p] : first[p + 1]][:: max(1, (first[p + 1] - first[p]) // BENT_SAMPLE)]
        apart = xyz[members] - xyz[members].mean(axis=0)
        u, v = (apart @ np.linalg.svd(apart, full_matrices=False)[2][:2].T).T
        columns = np.column_stack([u * u, v * v, u * v, u, v, np.ones(len(u))])
        bend = np.linalg.lstsq(columns, apart @ planes.normal[p], rcond=None)[0][:2]
        flat[p] = (2 * np.abs(bend) * np.sqrt(12) * [u.std(), v.std()]).max() < BENT
    flat[-1] = False  # of the points without a plane
    return np.where(flat, np.cumsum(flat) - 1, -1)[which].astype(np.int32)


def _sums(plane: I32, values: F64, count: int) -> F64:
    """(count, K) sums of values (N, K) by plane (N,)."""
    return np.stack([np.bincount(plane, column, count) for column in values.T], axis=1)
