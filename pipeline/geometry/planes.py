"""Plane detection in a cloud by region growing, with robust fitting. Import lazily: loads numba.

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
NEIGHBOUR_RADIUS_VOXELS = 2.6
"""Includes neighbours beyond one missing voxel."""
FLAT_PERCENTILE = 30
"""Percentile of the points' residuals that is the noise of flat surfaces: at least this part of buildings is flat."""
TOLERANCE_SIGMAS = 3.0
MIN_TOLERANCE_VOXELS, MAX_TOLERANCE_VOXELS = 0.15, 0.8
MIN_NORMAL_COS = float(np.cos(np.radians(20.0)))
"""Normals within one plane may differ by 20 degrees: their neighbourhoods extend around corners."""
MIN_PLANE_POINTS = 40
"""0.4 m2 at voxels of 10 cm."""
MAX_BEND_RAD = float(np.radians(10.0))
"""Largest change of the normal from end to end, by a parabola through the points; above it, the surface is curved."""
NARROW_VOXELS = 4.0
"""Width below which a plane beside curved surfaces counts as curved, too: a strip of a column may seem flat."""
BEND_SAMPLES = 2000
"""Maximum number of points for that fit."""
OFFSET_SCALE_M = 100.0
"""Difference of offsets that counts as much as an angle of one radian between normals, when planes are matched."""
GROWTH_ROUNDS = 2
"""Number of passes in which planes take in adjacent points, whose normals are those of a corner."""


@dataclass(frozen=True)
class Planes:
    """Planes `normal . x = offset`.

    Attributes:
        normal: (P, 3) unit vectors, to the outside of the surface.
        offset: (P,) metres.
    """

    normal: F64
    offset: F64

    def __len__(self) -> int:
        return len(self.offset)

    @staticmethod
    def join(parts: Sequence[Planes]) -> Planes:
        """Concatenate planes."""
        return Planes(np.concatenate([p.normal for p in parts]), np.concatenate([p.offset for p in parts]))

    def nearest(self, xyz: F32, normal: F32) -> I32:
        """Index (N,) of the plane most similar to the plane through each point (N, 3) with unit normal (N, 3)."""
        points, facing = xyz.astype(np.float64), normal.astype(np.float64)
        offset = np.einsum("ij,ij->i", points, facing)
        tree = cKDTree(np.column_stack([OFFSET_SCALE_M * self.normal, self.offset]))
        return np.asarray(tree.query(np.column_stack([OFFSET_SCALE_M * facing, offset]))[1], np.int32)

    def signed_distance(self, xyz: npt.NDArray[Any], which: I32) -> F64:
        """Signed distance (N,) in metres of points (N, 3) from planes `which` (N,), positive outside."""
        return np.einsum("ij,ij->i", xyz, self.normal[which]) - self.offset[which]


def detect(xyz: F32, normal: F32, voxel: float) -> tuple[Planes, I32, float]:
    """Detect planes in a thinned cloud.

    Args:
        xyz: (N, 3) local metres, one point per voxel.
        normal: (N, 3) unit normals to the outside.
        voxel: voxel size, metres.

    Returns:
        The planes; the index (N,) of each point's plane, -1 for none; and the tolerance, the largest distance in metres
        of a point from its plane: three times the noise of flat surfaces.
    """
    none = np.full(len(xyz), -1, np.int32)
    if len(xyz) < MIN_PLANE_POINTS:
        return Planes(np.zeros((0, 3)), np.zeros(0)), none, MIN_TOLERANCE_VOXELS * voxel
    points, normals = xyz.astype(np.float64), normal.astype(np.float64)
    near = (
        cKDTree(xyz)
        .query(xyz, NEIGHBOURS + 1, distance_upper_bound=NEIGHBOUR_RADIUS_VOXELS * voxel, workers=-1)[1]
        .astype(np.int32)
    )
    residual = _residuals(points, normals, near)
    tolerance = float(
        np.clip(
            TOLERANCE_SIGMAS * np.percentile(residual, FLAT_PERCENTILE),
            MIN_TOLERANCE_VOXELS * voxel,
            MAX_TOLERANCE_VOXELS * voxel,
        )
    )
    order = np.argsort(residual, kind="stable").astype(np.int32)
    which = _grow(
        points, normals, near, order[residual[order] <= tolerance], tolerance, MIN_NORMAL_COS, MIN_PLANE_POINTS
    )
    which = _remove_curved(points, near, which, _fit_planes(points, normals, which, tolerance), voxel)
    planes = _fit_planes(points, normals, which, tolerance)
    for _ in range(GROWTH_ROUNDS):
        which = _absorb_neighbours(points, near, which, np.ascontiguousarray(planes.normal), planes.offset, tolerance)
    return _fit_planes(points, normals, which, tolerance), which, tolerance


@njit(cache=True, parallel=True)
def _residuals(xyz: F64, normal: F64, near: I32) -> F64:
    """RMS distance (N,) of each point's neighbours to the plane through their mean."""
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
def _dot(points: F64, i: int, axis: F64) -> float:
    """Dot product of point i of (N, 3) with an axis (3,)."""
    return points[i, 0] * axis[0] + points[i, 1] * axis[1] + points[i, 2] * axis[2]


@njit(cache=True)
def _grow(
    xyz: F64, normal: F64, near: I32, seeds: I32, tolerance: float, min_normal_cos: float, min_points: int
) -> I32:
    """Region growing (N,) from each seed in turn: adds neighbours on the current plane; discards small regions."""
    n, found = len(xyz), 0
    which = np.full(n, -1, np.int32)
    members = np.empty(n, np.int32)
    for seed in seeds:
        if which[seed] >= 0:
            continue
        axis, level = normal[seed].copy(), _dot(xyz, seed, normal[seed])
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
                if j == n or which[j] >= 0 or _dot(normal, j, axis) <= min_normal_cos:
                    continue
                if abs(_dot(xyz, j, axis) - level) <= tolerance:
                    which[j] = found
                    members[count] = j
                    count += 1
        if count < min_points:
            for k in range(count):
                which[members[k]] = -1
        else:
            found += 1
    return which


@njit(cache=True, parallel=True)
def _absorb_neighbours(xyz: F64, near: I32, which: I32, normal: F64, offset: F64, tolerance: float) -> I32:
    """Assign points without a plane, or off their plane, to the nearest plane of their neighbours."""
    n = len(xyz)
    out = which.copy()
    for i in prange(n):
        best, own = tolerance, which[i]
        if own >= 0:
            if abs(_dot(xyz, i, normal[own]) - offset[own]) <= tolerance:
                continue
            out[i] = -1
        for j in near[i]:
            if j < n and which[j] >= 0:
                d = abs(_dot(xyz, i, normal[which[j]]) - offset[which[j]])
                if d < best:
                    best = d
                    out[i] = which[j]
    return out


def _fit_planes(xyz: F64, normal: F64, which: I32, tolerance: float) -> Planes:
    """Plane of each region, by iteratively reweighted least squares (Tukey's biweight)."""
    count = int(which.max(initial=-1)) + 1
    own = np.flatnonzero(which >= 0)
    plane, points = which[own], xyz[own]
    weight = np.ones(len(own))
    planes = Planes(np.zeros((count, 3)), np.zeros(count))
    outward = _sums(plane, normal[own], count)
    for _ in range(3):
        total = np.maximum(np.bincount(plane, weight, count), 1e-12)
        middle = _sums(plane, points * weight[:, None], count) / total[:, None]
        apart = points - middle[plane]
        outer = np.einsum("ni,nj,n->nij", apart, apart, weight).reshape(-1, 9)
        axis = np.linalg.eigh(_sums(plane, outer, count).reshape(-1, 3, 3))[1][:, :, 0]
        axis = axis * np.where((axis * outward).sum(axis=1) < 0, -1.0, 1.0)[:, None]
        planes = Planes(axis, (axis * middle).sum(axis=1))
        weight = np.maximum(0.0, 1 - (planes.signed_distance(points, plane) / (1.5 * tolerance)) ** 2) ** 2
    return planes


def _remove_curved(xyz: F64, near: I32, which: I32, planes: Planes, voxel: float) -> I32:
    """Remove planes that are strips of a curved surface, and renumber the planes of the points."""
    order = np.argsort(which, kind="stable")
    first = np.searchsorted(which[order], np.arange(len(planes) + 1))
    flat, narrow = np.zeros((2, len(planes) + 1), bool)  # the last entry is that of points without a plane
    for p in range(len(planes)):
        members = order[first[p] : first[p + 1]]
        apart = xyz[members[:: len(members) // BEND_SAMPLES + 1]] - xyz[members].mean(axis=0)
        u, v = (apart @ np.linalg.svd(apart, full_matrices=False)[2][:2].T).T
        columns = np.column_stack([u * u, v * v, u * v, u, v, np.ones(len(u))])
        bend = np.linalg.lstsq(columns, apart @ planes.normal[p], rcond=None)[0][:2]
        width = np.sqrt(12) * np.array([u.std(), v.std()])
        flat[p], narrow[p] = (2 * np.abs(bend) * width).max() < MAX_BEND_RAD, width.min() < NARROW_VOXELS * voxel
    plane = np.append(which, -1)  # the last entry is that of missing neighbours
    for p in np.flatnonzero(flat & narrow).tolist():
        beside = plane[near[order[first[p] : first[p + 1]]]]
        beside = beside[(beside >= 0) & (beside != p)]
        flat[p] = flat[beside].sum() * 2 >= len(beside)
    return np.where(flat, np.cumsum(flat) - 1, -1)[which].astype(np.int32)


def _sums(plane: I32, values: F64, count: int) -> F64:
    """Sums (count, K) of values (N, K) per plane (N,)."""
    return np.stack([np.bincount(plane, column, count) for column in values.T], axis=1)
