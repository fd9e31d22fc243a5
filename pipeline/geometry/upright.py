"""Up axis of a map from its surfaces: floors and ceilings are level, walls and poles upright.

A SLAM map's axes are those of the sensor at its start: tilted as the robot stood, or any (an obliquely mounted
solid-state lidar), or a camera's (LOAM and its descendants: y up). Every direction is rated by the normals of flat
surfaces that would be level or upright, by how few heights the level ones have (floors are large, walls are many), and
by the extent along it. The best direction is refined by robust least squares; its sign follows from what is above and
below.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from scan2sim.pipeline.core.types import F32, F64, I64, Bools

MIN_FLAT_POINTS = 200
"""Voxels on flat surfaces below which no direction can be found."""
DIRECTIONS_AT_ONCE = 16
"""Directions that are rated at once, so that their cosines (1 MB) stay in the processor's cache."""


@dataclass(frozen=True)
class UprightModel:
    """Limits of the search."""

    points_max: int = 500_000
    """Points that are used; others of a larger map are skipped."""
    voxels_max: int = 100_000
    neighbours: int = 16
    flat_variation_max: float = 0.04
    """Smallest eigenvalue over the sum, of a neighbourhood on a flat surface."""
    line_ratio_max: float = 0.12
    """Ratio of the second to the first eigenvalue up to which a neighbourhood is a line (one ring of a scan)."""
    grid_deg: float = 2.0
    """Spacing of the directions that are rated."""
    tolerance_deg: float = 4.0
    """Angle from level or upright that counts as such in the rating."""
    candidates: int = 6
    separation_deg: float = 15.0
    """Smallest angle between two candidates."""
    layer_m: float = 0.4
    """Thickness of a layer of level points, such as a floor."""
    level_weight: float = 0.5
    """Weight of the share of points in the two largest layers."""
    flatness_weight: float = 0.25
    """Weight of the logarithm of the map's horizontal to its vertical extent."""
    axis_weight: float = 0.15
    """Weight of a direction within `axis_deg` of the map's z axis; half of that for its y axis."""
    axis_deg: float = 20.0
    axis_sign_weight: float = 0.1
    """Weight of the map's z or y axis in the choice of the sign."""
    floor_share: float = 0.01
    """Share of all points in a level layer from which it is a floor or ceiling."""
    ground_points_min: float = 0.2
    """Share of all points in level layers from which these are ground outdoors, however far away, ..."""
    ground_width_min_m: float = 30.0
    """... if it is as wide as this."""
    step_m: tuple[float, float, float] = (0.5, 0.5, 0.25)
    """Voxels of level surfaces, of which neighbouring ones belong to one surface."""
    furniture_max_m: float = 7.0
    """Width up to which a level surface may be furniture, ..."""
    furniture_share_max: float = 0.5
    """... if it is no wider than this share of the map."""
    around_start_m: float = 10.0
    sensor_height_max_m: float = 1.9
    """Height of the sensor above the floor up to which a single level layer is a floor without doubt."""
    refine_deg: tuple[float, ...] = (8.0, 4.0, 2.0, 1.0, 1.0)
    """Scales of the Cauchy weights in the rounds of the refinement."""
    ground_share: float = 0.1
    """Share of the weight of level surfaces in the refinement where there are walls: roads slope, walls don't."""
    walls_min: float = 0.05
    """Share of upright surfaces from which they determine the direction."""


MODEL = UprightModel()


@dataclass(frozen=True)
class Upright:
    """Up axis of a map.

    Attributes:
        up: (3,) unit vector in the map's axes.
        level_share, upright_share: shares of the flat surfaces that are level and upright.
        margin: rating of the direction minus that of the next best; below `MARGIN_MIN` it is ambiguous.
        sign_margin: evidence for the direction's sign; below `SIGN_MARGIN_MIN` up and down may be swapped.
    """

    up: F64
    level_share: float
    upright_share: float
    margin: float
    sign_margin: float

    @property
    def has_walls(self) -> bool:
        """Whether upright surfaces determine the direction; else it is the ground's normal, which may slope."""
        return self.upright_share >= MODEL.walls_min

    @property
    def ambiguous(self) -> bool:
        """Whether another direction is almost as good, or up and down can't be distinguished."""
        return self.margin < MARGIN_MIN or self.sign_margin < SIGN_MARGIN_MIN

    def tilt_deg(self) -> float:
        """Angle between the up axis and the map's z axis, degrees."""
        return math.degrees(math.acos(np.clip(self.up[2], -1.0, 1.0)))


MARGIN_MIN, SIGN_MARGIN_MIN = 0.05, 0.05


class _Flat(NamedTuple):
    """Points (N, 3) and unit normals (N, 3) of flat surfaces."""

    xyz: F64
    normal: F64


def find_up(xyz: F32, origin: F64 | None = None) -> Upright | None:
    """Up axis of a map; None if it has too few flat surfaces.

    Args:
        xyz: (N, 3) points in the map's axes, metres, without outliers.
        origin: (3,) position of the sensor at the start of the map in the same axes; robots' maps have it at zero.
    """
    points = _thinned(xyz)
    flat = _flat_surfaces(points)
    if len(flat.xyz) < MIN_FLAT_POINTS:
        return None
    rated = sorted(((_rating(u, flat, points), tuple(u)) for u in _candidates(flat)), reverse=True)
    margin = rated[0][0] - rated[1][0] if len(rated) > 1 else 1.0
    up = _refine(np.array(rated[0][1]), flat)
    evidence, doubtful = _sign(up, flat, points, np.zeros(3) if origin is None else origin)
    up = up if evidence >= 0 else -up
    cos = np.abs(flat.normal @ up)
    level, upright = _level(cos, 2 * MODEL.tolerance_deg), _upright(cos, 2 * MODEL.tolerance_deg)
    return Upright(up, float(level.mean()), float(upright.mean()), margin, 0.0 if doubtful else abs(evidence))


def rotation_to_z(up: F64) -> F64:
    """(3, 3) rotation that turns `up` (3,) to z by the smallest angle; half a turn about x if it points down."""
    z = np.array([0.0, 0.0, 1.0])
    axis, cos = np.cross(up, z), float(up @ z)
    if cos < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + K + K @ K / (1 + cos)


def _thinned(xyz: F32) -> F64:
    """The points without far ones, if they are more than `voxels_max` the centroids of voxels."""
    points = xyz[:: max(1, len(xyz) // MODEL.points_max)].astype(np.float64)
    low, high = np.percentile(points, (0.5, 99.5), axis=0)
    points = points[np.all((points >= low - 1) & (points <= high + 1), axis=1)]
    size = max(0.05, float((high - low).max()) / 1000)
    while len(points) > MODEL.voxels_max:
        keys = np.floor((points - points.min(axis=0)) / size).astype(np.int64)
        span = keys.max(axis=0) + 1
        flat = (keys[:, 0] * span[1] + keys[:, 1]) * span[2] + keys[:, 2]
        _, index, count = np.unique(flat, return_inverse=True, return_counts=True)
        if len(count) <= MODEL.voxels_max:
            points = np.stack([np.bincount(index, points[:, k]) / count for k in range(3)], axis=1)
        size *= 1.3
    return points


def _flat_surfaces(points: F64) -> _Flat:
    """Points whose neighbourhood is flat, with its normal."""
    from scipy.spatial import cKDTree

    k = min(MODEL.neighbours, len(points) - 1)
    if k < 5:
        return _Flat(np.zeros((0, 3)), np.zeros((0, 3)))
    index = cKDTree(points).query(points, k + 1, workers=-1)[1]
    around = points[index] - points[index].mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
    variation = values[:, 0] / np.maximum(values.sum(axis=1), 1e-12)
    line = values[:, 1] < MODEL.line_ratio_max * values[:, 2]
    flat = (variation < MODEL.flat_variation_max) & ~line
    return _Flat(points[flat], vectors[flat, :, 0])


def _level(cos: F64, tolerance_deg: float) -> Bools:
    """Whether normals with these |cosines| to the up axis belong to level surfaces."""
    return cos > math.cos(math.radians(tolerance_deg))


def _upright(cos: F64, tolerance_deg: float) -> Bools:
    """Whether normals with these |cosines| to the up axis belong to upright surfaces."""
    return cos < math.sin(math.radians(tolerance_deg))


def _candidates(flat: _Flat) -> list[F64]:
    """Directions with the most level and upright surfaces, each well separated from the others."""
    grid = _directions()
    normal = flat.normal[:: max(1, len(flat.normal) // 8_000)]
    # what directions without any relation to the surfaces would have
    tolerance = math.radians(MODEL.tolerance_deg)
    by_chance = 1 - math.cos(tolerance) + math.sin(tolerance)
    blocks = np.array_split(grid, math.ceil(len(grid) / DIRECTIONS_AT_ONCE))
    level, either = np.concatenate([_level_and_either(block, normal) for block in blocks]).T / len(normal)
    score = either - by_chance
    found: list[F64] = []
    for by in (score, level):
        order = np.argsort(-by)
        chosen: list[F64] = []
        for i in order:
            if len(chosen) == MODEL.candidates:
                break
            if all(abs(grid[i] @ other) < math.cos(math.radians(MODEL.separation_deg)) for other in chosen):
                chosen.append(grid[i])
        found += chosen
    refined: list[F64] = []
    for u in found:
        u = _refine(u, flat)
        if all(abs(u @ other) < math.cos(math.radians(MODEL.separation_deg / 2)) for other in refined):
            refined.append(u)
    return refined


def _level_and_either(directions: F64, normal: F64) -> I64:
    """(D, 2) numbers of normals (N, 3) of level surfaces, and of level or upright ones, by direction (D, 3)."""
    cos = np.abs(directions @ normal.T)
    level = _level(cos, MODEL.tolerance_deg)
    masks = (level, level | _upright(cos, MODEL.tolerance_deg))
    return np.stack([np.count_nonzero(mask, axis=1) for mask in masks], axis=1)


def _directions() -> F64:
    """(D, 3) directions evenly on a hemisphere (Fibonacci lattice)."""
    count = round(2 * math.pi / math.radians(MODEL.grid_deg) ** 2)
    i = np.arange(count) + 0.5
    z = 1 - i / count
    turn = math.pi * (1 + math.sqrt(5)) * i
    r = np.sqrt(1 - z * z)
    return np.column_stack([r * np.cos(turn), r * np.sin(turn), z])


def _rating(up: F64, flat: _Flat, points: F64) -> float:
    """Rating of a direction as the up axis, whatever its sign."""
    cos = np.abs(flat.normal @ up)
    level, upright = _level(cos, 2 * MODEL.tolerance_deg), _upright(cos, 2 * MODEL.tolerance_deg)
    height = points @ up
    extent = np.ptp(np.percentile(height, (2, 98)))
    across = points - height[:, None] * up
    width = math.sqrt(float(np.linalg.eigvalsh(np.cov(across.T))[-2:].prod()) ** 0.5) * 3.5
    axis = math.cos(math.radians(MODEL.axis_deg))
    prior = 1.0 if abs(up[2]) > axis else 0.5 if abs(up[1]) > axis else 0.0
    return (
        float((level | upright).mean())
        + MODEL.level_weight * _layers(flat.xyz[level] @ up) * float(level.mean())
        + MODEL.flatness_weight * math.log(max(width, 0.1) / max(float(extent), 0.1))
        + MODEL.axis_weight * prior
    )


def _layers(height: F64) -> float:
    """Share of heights (N,) in the two largest layers."""
    if not len(height):
        return 0.0
    low = float(height.min())
    count = np.bincount(((height - low) / (MODEL.layer_m / 2)).astype(np.int64))
    pairs = count + np.append(count[1:], 0)
    first = int(pairs.argmax())
    others = pairs.copy()
    others[max(0, first - 2) : first + 3] = 0
    return float(pairs[first] + others.max()) / len(height)


def _refine(up: F64, flat: _Flat) -> F64:
    """Direction by iteratively reweighted least squares.

    The sum of squared sines of walls' elevations and of floors' slopes is a quadratic form; its smallest eigenvector
    is the solution.
    """
    for scale_deg in MODEL.refine_deg:
        cos = flat.normal @ up
        wall = np.arcsin(np.clip(np.abs(cos), 0, 1))
        slope = np.arccos(np.clip(np.abs(cos), 0, 1))
        scale = math.radians(scale_deg)
        wall_weight, floor_weight = (np.where(a < 3 * scale, 1 / (1 + (a / scale) ** 2), 0.0) for a in (wall, slope))
        if wall_weight.sum() > MODEL.walls_min * len(cos):
            limit = MODEL.ground_share * wall_weight.sum() / max(float(floor_weight.sum()), 1e-9)
            floor_weight *= min(1.0, limit)
        A = (flat.normal * (wall_weight - floor_weight)[:, None]).T @ flat.normal
        solved = np.linalg.eigh(A)[1][:, 0]
        up = solved if solved @ up >= 0 else -solved
    return up


def _sign(up: F64, flat: _Flat, points: F64, origin: F64) -> tuple[float, bool]:
    """Evidence that `up` points up, from -1 to 1, negative if down is up; and whether parts of it contradict others.

    Outdoors, almost everything is above the ground. The sensor starts nearer to the floor than to the ceiling, or to
    the top of what is around it, and furniture stands on the floor. Without such evidence, the axes decide: z up, or
    LOAM's y up. They also decide if there is one level layer, further from the sensor than what ends the map at the
    other side: it may be the ceiling of a map whose floor was removed, unless it has so many of the points that it
    is ground outdoors. Furniture alone contradicts any sign.
    """
    turn = rotation_to_z(up).T
    height = points @ up
    surfaces = flat.xyz[_level(np.abs(flat.normal @ up), 4 * MODEL.tolerance_deg)] @ turn
    level = surfaces[:, 2]
    width = _width(surfaces) if len(level) > MODEL.floor_share * len(height) else math.inf
    low, high = np.percentile(height, (2, 98))
    # large layers near the ends of the map are its ground or floor, and ceiling; reflections may lie beyond them
    ends = (low - MODEL.layer_m, high + MODEL.layer_m)
    count, edges = np.histogram(level, max(4, int((ends[1] - ends[0]) / MODEL.layer_m)), ends)
    large = np.flatnonzero(count > MODEL.floor_share * len(height))
    middle = (low + high) / 2
    floor, ceiling = float(low), float(high)
    evidence = 0.0
    one_end = False
    is_ground = width > MODEL.ground_width_min_m and count[large].sum() > MODEL.ground_points_min * len(height)
    if len(large):
        off = (edges[large] + edges[large + 1]) / 2 - middle
        quarter = (edges[1] - edges[0]) / 4  # a layer at half the height is neither below nor above
        below, above = (float(count[large][side].sum()) for side in (off < -quarter, off > quarter))
        one_end = min(below, above) < 0.1 * max(below, above)
        evidence += 0.5 * (below - above) / max(below + above, 1.0)  # a floor is seen better than a ceiling
        floor = float(edges[large[0]]) if below else floor
        ceiling = float(edges[large[-1] + 1]) if above else ceiling
    start, layer = float(origin @ up), floor if evidence > 0 else ceiling
    near = np.linalg.norm(points - origin, axis=1) < MODEL.around_start_m
    if near.sum() > MIN_FLAT_POINTS:
        floor, ceiling = (float(v) for v in np.percentile(height[near], (2, 98)))
    by_start = 0.5 * (floor + ceiling - 2 * start) / max(ceiling - floor, 0.1) if floor < start < ceiling else 0.0
    doubtful = one_end and evidence * by_start < 0
    if not one_end:  # otherwise what ends the map at the top is not a ceiling
        evidence += by_start
    elif doubtful and abs(layer - start) > MODEL.sensor_height_max_m and not is_ground:
        evidence = 0.0
    z = up[2] if abs(up[2]) > 0.7 else 0.5 * up[1]
    doubtful = doubtful or _is_furniture(width, (points @ turn)[:, :2])
    return float(np.clip(evidence + MODEL.axis_sign_weight * z, -1, 1)), doubtful


def _width(level: F64) -> float:
    """Width of the widest connected surface of level points (N, 3), metres."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    voxels = np.unique(np.floor(level / MODEL.step_m), axis=0)
    i, j = cKDTree(voxels).query_pairs(1.5, p=np.inf, output_type="ndarray").T
    count, part = connected_components(coo_array((np.ones(len(i)), (i, j)), shape=(len(voxels), len(voxels))))
    low, high = np.full((2, count, 2), [[[np.inf]], [[-np.inf]]])
    np.minimum.at(low, part, voxels[:, :2])
    np.maximum.at(high, part, voxels[:, :2])
    return float((high - low).max() + 1) * MODEL.step_m[0]


def _is_furniture(width: float, xy: F64) -> bool:
    """Whether the widest level surface is too small for a floor, ceiling or ground of a map with positions (N, 2)."""
    extent = float(np.ptp(np.percentile(xy, (2, 98), axis=0), axis=0).max())
    return width < min(MODEL.furniture_max_m, MODEL.furniture_share_max * extent)
