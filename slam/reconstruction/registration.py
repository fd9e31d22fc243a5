"""Registration of a reconstruction to a point cloud: candidates by ICP of its sparse points, and a local search.

The candidates are results of point-to-plane ICP (Chen and Medioni, Object modelling by registration of multiple range
images, 1992) with a Cauchy loss. GPS is off by metres, so it starts from several shifts; its result is only a
candidate, as sparse points of a camera that moves forward are biased along their rays. A score of photos and cloud
(`pipeline.pose_check.photo_fit`) decides among them, and is maximized by `climb`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from scan2sim.pipeline.core.types import F64, I64
from scan2sim.pipeline.geometry.similarity import Similarity
from scan2sim.slam.geometry import exp_so3
from scan2sim.slam.scan_pairs import Surface


@dataclass(frozen=True)
class RegistrationModel:
    """Parameters of the registration.

    Attributes:
        range_m: greatest distance of a used point from the cameras.
        points_max: sparse points that are registered.
        sigma_max_m: standard deviation of a point by triangulation above which it isn't used.
        surface_sigma_m: standard deviation of the surfaces.
        gates_m: largest distance of a point from its surface, in each iteration.
        search_m: largest distance along a surface to its nearest point.
        information_min: share of the points' information on a direction below which it keeps its given value.
        start_steps: starts along each horizontal axis, and heights.
        fit_m: distance from a surface up to which a point fits.
        support_m: standard deviation of the Gaussian of the distance from a surface.
        distinct_m: displacement of a camera from which on two results differ.
    """

    range_m: float = 50.0
    points_max: int = 1000
    sigma_max_m: float = 0.4
    surface_sigma_m: float = 0.03
    gates_m: tuple[float, ...] = (3.0, 2.0, 2.0, 1.5, 1.5, 1.0, 1.0, 1.0, 0.7, 0.7, 0.5, 0.5, 0.5)
    search_m: float = 1.0
    information_min: float = 0.001
    start_steps: int = 3
    fit_m: float = 0.2
    support_m: float = 0.05
    distinct_m: float = 0.15


MODEL = RegistrationModel()


def candidates(
    points: F64, sigma: F64, centres: F64, surface: Surface, coarse: Similarity, radius: float
) -> list[Similarity]:
    """Possible registrations of sparse points to a cloud: results of ICP from several starts, best first.

    Args:
        points: (N, 3) sparse points, model coordinates.
        sigma: (N,) their standard deviations, in the model's unit.
        centres: (P, 3) camera centres, model coordinates.
        surface: surfaces of the cloud, local metres.
        coarse: approximate similarity from the model to local metres.
        radius: metres by which it may be off.
    """
    few = usable(points, sigma, centres, coarse)
    middle = centres.mean(axis=0)
    found = []
    for start in _starts(coarse, centres, surface, radius):
        onto = _icp(points[few], sigma[few], middle, surface, start, MODEL.gates_m)
        found.append((_share(points[few], surface, onto), onto))
    found.sort(key=lambda item: -item[0])
    kept: list[Similarity] = []
    for _, onto in found:
        placed = onto.apply(centres)
        apart = [np.linalg.norm(placed - other.apply(centres), axis=1).max() for other in kept]
        if not kept or min(apart) > MODEL.distinct_m:
            kept.append(onto)
    return kept


def usable(points: F64, sigma: F64, centres: F64, coarse: Similarity) -> I64:
    """Indices of at most about `points_max` precise points near the cameras; arguments as of `candidates`."""
    from scipy.spatial import cKDTree

    near = cKDTree(centres).query(points)[0] * coarse.scale < MODEL.range_m
    found = np.flatnonzero(near & (sigma * coarse.scale < MODEL.sigma_max_m))
    return found[:: max(1, len(found) // MODEL.points_max)]


def support(points: F64, surface: Surface, onto: Similarity) -> float:
    """How well points (N, 3) are on surfaces: mean of a Gaussian of the distance, 0 to 1."""
    r = _distances(points, surface, onto)
    return float(np.exp(-0.5 * (r / MODEL.support_m) ** 2).sum()) / max(len(points), 1)


def climb(
    score: Callable[[Similarity], float], start: Similarity, middle: F64, reach: float, steps: Sequence[float]
) -> tuple[Similarity, float]:
    """Local maximum of a score by pattern search over position, rotation and scale (Hooke and Jeeves, 1961).

    Args:
        score: function to maximize.
        start: first similarity.
        middle: (3,) point of the model that it rotates about.
        reach: metres from there at which a rotation or scaling moves points by a step.
        steps: metres, descending.
    """
    best, value = start, score(start)
    for step in steps:
        for _ in range(4):
            before = value
            for k in range(7):
                for sign in (1, -1):
                    change = np.zeros(7)
                    change[k] = sign * step / (1 if k < 3 else reach)
                    trial = moved(best, middle, change)
                    found = score(trial)
                    if found > value:
                        best, value = trial, found
                        break
            if value - before < 1e-3:
                break
    return best, value


def moved(onto: Similarity, middle: F64, change: F64) -> Similarity:
    """Similarity moved by a shift (metres), rotated about the model's point `middle` (rad) and scaled (relative)."""
    centre = onto.apply(middle[None])[0]
    rotation, scale = exp_so3(change[3:6]) @ onto.rotation, onto.scale * (1 + change[6])
    return Similarity(scale, rotation, centre + change[:3] - scale * rotation @ middle)


def _starts(coarse: Similarity, centres: F64, surface: Surface, radius: float) -> Iterator[Similarity]:
    """The coarse similarity shifted along and across the path, at its own height and at a camera's above ground."""
    from scipy.spatial import cKDTree

    placed = coarse.apply(centres)
    distance, nearest = cKDTree(surface.points[:, :2]).query(placed[:, :2], k=30, distance_upper_bound=4.0)
    heights = [0.0]
    seen = np.isfinite(distance).all(axis=1)
    if seen.any():
        ground = np.quantile(surface.points[nearest[seen], 2], 0.1, axis=1)
        offsets = ground - placed[seen, 2]
        heights += [float(np.median(offsets)) + above for above in (1.2, 2.0, 3.0)]
    ahead = placed[-1, :2] - placed[0, :2]
    ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-9) if np.linalg.norm(ahead) > 1 else np.array([1.0, 0.0])
    across = np.array([-ahead[1], ahead[0]])
    steps = np.linspace(-radius, radius, MODEL.start_steps)
    for height in heights:
        for along in steps:
            for side in steps:
                shift = np.append(along * ahead + side * across, height)
                yield Similarity(coarse.scale, coarse.rotation, coarse.translation + shift)


def _icp(
    points: F64, sigma: F64, middle: F64, surface: Surface, onto: Similarity, gates: tuple[float, ...]
) -> Similarity:
    """Point-to-plane ICP of six parameters; those that the surfaces don't constrain keep their value."""
    for gate in gates:
        centre = onto.apply(middle[None])[0]
        placed = onto.apply(points)
        arm = placed - centre
        reach = float(np.sqrt((arm**2).sum(axis=1).mean()))
        distance, nearest = surface.tree.query(placed, distance_upper_bound=max(gate, MODEL.search_m))
        met = np.flatnonzero(np.isfinite(distance))
        normal = surface.normals[nearest[met]]
        r = np.einsum("ki,ki->k", normal, placed[met] - surface.points[nearest[met]])
        on = np.abs(r) < gate
        met, normal, r = met[on], normal[on], r[on]
        if len(met) < 20:
            return onto
        noise = np.hypot(sigma[met] * onto.scale, max(MODEL.surface_sigma_m, 0.1 * gate))
        weight = 1 / noise**2 / (1 + (r / noise) ** 2)
        J = np.column_stack([normal, np.cross(arm[met], normal) / reach])
        Jw = J * weight[:, None]
        values, vectors = np.linalg.eigh(Jw.T @ J)
        known = values > MODEL.information_min * weight.sum()
        step = vectors[:, known] @ ((vectors[:, known].T @ (Jw.T @ -r)) / values[known])
        onto = moved(onto, middle, np.concatenate([step[:3], step[3:] / reach, [0.0]]))
        if gate == gates[-1] and np.abs(step).max() < 1e-4:
            break
    return onto


def _share(points: F64, surface: Surface, onto: Similarity) -> float:
    """Share of the points that are on surfaces."""
    return float((_distances(points, surface, onto) < MODEL.fit_m).sum()) / max(len(points), 1)


def _distances(points: F64, surface: Surface, onto: Similarity) -> F64:
    """Distances (K,) of the points that are near a surface from it, metres."""
    placed = onto.apply(points)
    distance, nearest = surface.tree.query(placed, distance_upper_bound=MODEL.search_m)
    met = np.flatnonzero(np.isfinite(distance))
    along = placed[met] - surface.points[nearest[met]]
    return np.asarray(np.abs(np.einsum("ki,ki->k", surface.normals[nearest[met]], along)))
