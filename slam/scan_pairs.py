"""Agreement of a scanner's path with its sweeps: distances between surfaces that were scanned at different times.

Pairs of sweeps that show the same surfaces, a few metres apart on the path (neighbours) or on different passes of the
same place, are registered by point-to-plane ICP (Chen and Medioni, 1992), starting at the given poses. A good path
needs no correction: the correction is the disagreement of the path with its own data. The same pairs are constraints
by which `trajectory/fusion.py` corrects a path.

Between neighbours, roll and pitch remain those of the given path: errors of a scanner's beam angles bend the ground of
a sweep, so that registration of sweeps a few metres apart would bend the path (1.2 mrad per 4.5 m with KITTI's
Velodyne). Passes of a place see the same ground from the same side, where this cancels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from scan2sim.pipeline.core.types import F64, I64, Bools
from scan2sim.slam.geometry import exp_so3, inverse, rigid


@dataclass(frozen=True)
class PairModel:
    """Selection of pairs, and their registration."""

    range_m: float = 50.0
    """Range of the points that are registered."""
    voxel_m: float = 0.15
    """Points of a surface are thinned to one per voxel before normals are estimated."""
    normal_neighbours: int = 12
    """Points that a normal is estimated from."""
    normal_radius_m: float = 1.0
    """Distance of these points."""
    flatness_max: float = 0.12
    """Ratio of the smallest to the middle standard deviation of these points, above which there is no normal."""
    points_max: int = 4000
    """Points of a sweep that are registered."""
    gates_m: tuple[float, ...] = (1.0, 1.0, 0.7, 0.5, 0.4, 0.3, 0.3, 0.3, 0.3)
    """Largest distance of a point from its surface, in each iteration."""
    step_min: float = 2e-4
    """Iterations stop at a smaller update (m, rad)."""
    scatter_min_m: float = 0.02
    """Least scatter of points about their surface: scale of the Cauchy loss."""
    information_min: float = 0.004
    """Share of the points' information on a direction below which the pair doesn't constrain it."""
    correlated_points: float = 20.0
    """Number of points that share one error."""
    sigma_min: tuple[float, float] = (0.005, 0.0003)
    """Least standard deviation of a registration: metres, radians."""
    unknown_variance: float = 4.0
    """Variance of a direction that a pair doesn't constrain: m², or rad² times the squared `lever_m`."""
    overlap_min: float = 0.3
    """Share of a sweep's points on surfaces of the other one, below which a pair is rejected."""
    key_spacing_m: float = 1.5
    """Distance along the path between sweeps that are compared."""
    neighbour_spacing_m: float = 4.0
    """Distance along the path between neighbours that are compared."""
    pass_distance_m: float = 8.0
    """Largest distance between sweeps of two passes."""
    pass_detour_m: float = 30.0
    """Least distance along the path between sweeps of two passes."""
    lever_m: float = 10.0
    """Distance from the scanner at which a rotation counts as a displacement."""


MODEL = PairModel()
CELLS = 1 << 20
"""Voxels along an axis of a sweep."""


class Surface(NamedTuple):
    """Points on surfaces: `points` (P, 3), unit `normals` (P, 3), and a k-d tree of the points."""

    points: F64
    normals: F64
    tree: Any


@dataclass(frozen=True)
class Pairs:
    """Registered pairs of sweeps.

    Attributes:
        first, second: (K,) indices of the sweeps.
        T: (K, 4, 4) registered pose of the second sweep in the first's axes.
        covariance: (K, 6, 6) of position (m) and rotation (rad), in the second's axes.
        displacement: (K,) metres by which registration displaces a surface 10 m away from the scanner: the
            disagreement of the path.
        residual: (K,) median distance of points from the other sweep's surfaces after registration, metres.
        passes: (K,) whether the sweeps are of different passes.
    """

    first: I64
    second: I64
    T: F64
    covariance: F64
    displacement: F64
    residual: F64
    passes: Bools

    def __len__(self) -> int:
        return len(self.first)


def surface_of(points: F64) -> Surface:
    """Surfaces of a sweep's points (N, 3)."""
    from scipy.spatial import cKDTree

    cells = np.floor(points / MODEL.voxel_m).astype(np.int64) + CELLS // 2
    points = points[np.sort(np.unique(cells @ [CELLS**2, CELLS, 1], return_index=True)[1])]
    k = MODEL.normal_neighbours
    if len(points) < k:
        return Surface(np.zeros((0, 3)), np.zeros((0, 3)), cKDTree(np.zeros((0, 3))))
    gap, nearest = cKDTree(points).query(points, k)
    centre = points[nearest].mean(axis=1)
    offset = points[nearest] - centre[:, None]
    spread, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", offset, offset))
    flat = (spread[:, 0] < MODEL.flatness_max**2 * spread[:, 1]) & (gap[:, -1] < MODEL.normal_radius_m)
    return Surface(centre[flat], axes[flat, :, 0], cKDTree(centre[flat]))


class Registration(NamedTuple):
    """Result of `register`: pose (4, 4), its covariance (6, 6) in its axes, residual (m), share of points that fit."""

    T: F64
    covariance: F64
    residual: float
    overlap: float


def register(points: F64, surface: Surface, T: F64, *, tilt: bool = True) -> Registration | None:
    """Point-to-plane registration.

    Args:
        points: (N, 3) points of a sweep, in its axes.
        surface: surfaces of another sweep, in its axes.
        T: (4, 4) approximate pose of the first in the axes of the second.
        tilt: estimate roll and pitch, too; otherwise only position and heading.

    Returns:
        The registration; directions that the surfaces don't constrain keep their given value. None without overlap.
    """
    points = points[:: max(1, len(points) // MODEL.points_max)]
    if not len(points) or not len(surface.points):
        return None
    units = np.repeat([1.0, 1 / MODEL.lever_m], 3)
    free = np.array([True, True, True, tilt, tilt, True])
    for gate in MODEL.gates_m:
        world = points @ T[:3, :3].T
        moved = world + T[:3, 3]
        far, nearest = surface.tree.query(moved, distance_upper_bound=max(gate, MODEL.normal_radius_m))
        met = np.flatnonzero(np.isfinite(far))
        normal = surface.normals[nearest[met]]
        r = np.einsum("ki,ki->k", normal, moved[met] - surface.points[nearest[met]])
        near = np.abs(r) < gate
        met, normal, r = met[near], normal[near], r[near]
        overlap = len(met) / len(points)
        if overlap < MODEL.overlap_min:
            return None
        scatter = max(MODEL.scatter_min_m, 1.4826 * float(np.median(np.abs(r))))
        weight = 1 / (1 + (r / scatter) ** 2)
        J = np.concatenate([normal, np.cross(world[met], normal)], axis=1) * units * free
        Jw = J * weight[:, None]
        values, vectors = np.linalg.eigh(Jw.T @ J)
        known = values > MODEL.information_min * weight.sum()
        step = vectors[:, known] @ ((vectors[:, known].T @ (Jw.T @ -r)) / values[known]) * units
        T = rigid(exp_so3(step[3:]) @ T[:3, :3], T[:3, 3] + step[:3])
        if gate == MODEL.gates_m[-1] and np.abs(step).max() < MODEL.step_min:
            break
    variance = np.where(known, MODEL.correlated_points * scatter**2 / np.maximum(values, 1e-9), MODEL.unknown_variance)
    C = (vectors * units[:, None]) @ np.diag(variance) @ (vectors * units[:, None]).T
    C += np.diag(np.repeat(np.square(MODEL.sigma_min), 3))
    turn = np.kron(np.eye(2), T[:3, :3])  # to the second's axes
    return Registration(T, turn.T @ C @ turn, float(np.median(np.abs(r))), overlap)


def select(positions: F64, every_m: float = MODEL.key_spacing_m) -> tuple[I64, I64, Bools]:
    """Pairs of sweeps to compare: first, second (K,), and whether they are of different passes.

    Args:
        positions: (N, 3) of the scanner.
        every_m: distance along the path between sweeps that are compared with an earlier one.
    """
    from scipy.spatial import cKDTree

    travelled = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])
    at = np.unique(np.searchsorted(travelled, np.arange(0, travelled[-1] + 1e-9, every_m)))
    at = at[at < len(positions)]
    before = np.searchsorted(travelled, travelled[at] - MODEL.neighbour_spacing_m, "right") - 1
    first, second = [before[before >= 0]], [at[before >= 0]]
    far = [False] * int((before >= 0).sum())
    tree = cKDTree(positions)
    for i, near in zip(at, tree.query_ball_point(positions[at], MODEL.pass_distance_m), strict=True):
        earlier = np.array([j for j in near if travelled[i] - travelled[j] > MODEL.pass_detour_m], np.int64)
        if len(earlier):
            first.append(earlier[[np.argmin(np.linalg.norm(positions[earlier] - positions[i], axis=1))]])
            second.append(np.array([i]))
            far.append(True)
    return np.concatenate(first).astype(np.int64), np.concatenate(second).astype(np.int64), np.array(far, bool)


def compare(
    sweep: Callable[[int], F64],
    poses: F64,
    first: I64,
    second: I64,
    passes: Bools,
    report: Callable[[float, str], None] = lambda *_: None,
) -> Pairs:
    """Register pairs of sweeps, starting at given poses; pairs that don't overlap are left out.

    Args:
        sweep: points (N, 3) of a sweep in scanner axes at its time, deskewed, by index.
        poses: (N, 4, 4) scanner to world.
        first, second: (K,) indices of the sweeps.
        passes: (K,) whether they are of different passes.
        report: receives progress.
    """
    rows: dict[int, tuple[F64, F64, float, float]] = {}
    sweeps = np.unique(first).tolist()
    for done, i in enumerate(sweeps):
        report(done / len(sweeps), f"sweep {done + 1} of {len(sweeps)}")
        surface = surface_of(sweep(i))
        for k in np.flatnonzero(first == i).tolist():
            j = int(second[k])
            given = inverse(poses[i]) @ poses[j]
            found = register(sweep(j), surface, given, tilt=bool(passes[k]))
            if found is not None:
                correction = found.T @ inverse(given)
                turn = float(np.linalg.norm(correction[:3, :3] - np.eye(3)) / np.sqrt(2))
                shift = float(np.linalg.norm(found.T[:3, 3] - given[:3, 3]))
                rows[k] = (found.T, found.covariance, np.hypot(shift, turn * MODEL.lever_m), found.residual)
    kept = sorted(rows)
    count = len(kept)
    return Pairs(
        first[kept], second[kept],
        np.array([rows[k][0] for k in kept]).reshape(count, 4, 4),
        np.array([rows[k][1] for k in kept]).reshape(count, 6, 6),
        np.array([rows[k][2] for k in kept]), np.array([rows[k][3] for k in kept]), passes[kept],
    )  # fmt: skip
