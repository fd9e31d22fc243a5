"""Point classification by shape alone, for clouds without classes.

Ground by a morphological filter (SMRF: Pingel, Clarke, McBride, "An improved simple morphological
filter for the terrain classification of airborne LIDAR data", ISPRS J. 77, 2013). Points above
ground by the covariance of each point's neighbourhood (Demantke et al., "Dimensionality based scale
selection in 3D lidar point clouds", ISPRS Laser Scanning 2011): large, high and smooth surfaces are
buildings, thin upright lines are poles, compact smooth components of a car's size are vehicles, and
rough components are vegetation.

Points above ground are classified as centroids of voxels, and the classes are transferred back to the points.
The lengths are those of dense clouds; given the point spacing of a sparse or noisy map, they are scaled (`Scale`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.step import Report, silent
from scan2sim.pipeline.core.types import F32, F64, I32, I64, U8, Bools, PointCloud

NEIGHBOURS = 20
MIN_POINTS = 30  # components with fewer points have no shape
# ground (SMRF)
GROUND_CELL_M = 0.5
GROUND_MAX_SLOPE = 0.15  # rise over run at the scale of the morphological opening
GROUND_WINDOW_M = 45.0  # largest radius of the opening: half the width of the widest roof
GROUND_TOLERANCE_M = 0.2  # distance of ground points from the ground surface, where that is level
GROUND_GAP_RADIUS_M = 5.0  # gaps wider than twice this are filled with the lowest height around them
# surfaces
SMOOTH_MAX_VARIATION = 0.04  # surface variation (smallest eigenvalue over the sum) of points on a smooth surface
BUILT_MAX_MEAN_VARIATION = 0.018  # its mean over a built surface; smooth tree crowns are above
SURFACE_MIN_NORMAL_COS = 0.95  # cosine between neighbouring normals on one surface
BUILDING_MIN_AREA_M2, BUILDING_MIN_HEIGHT_M = 5.0, 2.2
WALL_MIN_LENGTH_M, WALL_MIN_HEIGHT_M = 6.0, 0.8
# objects
VEHICLE_LENGTH_M, VEHICLE_WIDTH_M, VEHICLE_HEIGHT_M = (1.8, 6.5), (0.7, 3.0), (0.9, 2.6)
VEHICLE_MAX_VARIATION = 0.07
VEHICLE_BAND_M = (0.3, 1.2)  # heights of the doors, where a car is separate from kerbs and tree crowns
POLE_MAX_WIDTH_M, POLE_MIN_HEIGHT_M = 0.6, 1.5
VEGETATION_MIN_VARIATION = 0.03
VOTING_ROUNDS = 3


# sparse and noisy maps
SPARSE_CELL_SPACINGS = 2.0  # ground cell
SPARSE_TOLERANCE_SPACINGS = 1.1  # points at the centres of voxels are up to one spacing above the ground's lowest ones
THICKNESS_CELL_MIN_POINTS = 3
THICKNESS_OPEN_MAX_M = 1.2  # columns without higher points show the ground alone
THICKNESS_MAX_M = 0.45  # thicker columns are walls: the ground is missing
TOLERANCE_THICKNESSES = 1.8
NOISE_OF_THICKNESS = 0.4  # standard deviation of ground heights over their 90 % range
VOXEL_NOISES = 4.0  # a neighbourhood is about five voxels wide
SPARSE_MIN_POINTS = 8
SPARSE_MAX_CURVED = 0.04  # smallest eigenvalue over the sum of a built surface's points; half a tree crown is above
GRID_MAX_SPREAD = 0.02  # interquartile range of the distances to the nearest point, over their median, on a grid


@dataclass(frozen=True)
class Scale:
    """Lengths in metres, and limits, that depend on spacing and noise; the defaults are for dense clouds.

    Attributes:
        voxel: voxel size above ground.
        min_points: number of points from which a component has a shape.
        variation: surface variation that noise adds on a plane.
    """

    voxel: float = 0.2
    min_points: int = MIN_POINTS
    variation: float = 0.0

    @property
    def gap(self) -> float:
        """Factor of gaps and widths of thin objects."""
        return max(1.0, self.voxel / 0.2)


@dataclass(frozen=True)
class Shape:
    """Local shape of (M, 3) points, from their neighbourhoods.

    Attributes:
        near: (M, K) indices of the nearest points, nearest first, without the point itself.
        gap: (M, K) distances to them in metres.
        variation: (M,) smallest eigenvalue over the sum: 0 on a plane or line, 1/3 in a ball.
        linearity: (M,) (largest - middle) / largest eigenvalue.
        normal: (M, 3) unit, direction of the smallest eigenvalue.
        upright: (M,) |z| of the direction of the largest eigenvalue.
    """

    near: I32
    gap: F32
    variation: F32
    linearity: F32
    normal: F32
    upright: F32


def classify(cloud: PointCloud, report: Report = silent, *, voxel: float = 0.2, spacing: float | None = None) -> U8:
    """(N,) LAS codes: terrain, low/mid/high vegetation, building, wall_or_fence, vehicle, pole, unclassified.

    Args:
        cloud: points to classify; only positions are used.
        report: progress callback.
        voxel: voxel size in metres above ground. A neighbourhood, about five voxels wide, should be
            large compared to the noise of merged sweeps and small compared to a car.
        spacing: typical distance of neighbouring points in metres, to scale all lengths of the method with it and with
            the noise of the ground; None: a dense cloud.
    """
    xyz = cloud.xyz
    if len(xyz) < MIN_POINTS:
        return np.full(len(xyz), CODE["unclassified"], np.uint8)
    report(0.0, "ground")
    scale = Scale(voxel)
    if spacing is None:
        height, ground = split_ground(xyz)
    else:
        height, ground, scale = _split_sparse(xyz, voxel, spacing)
    classification = np.full(len(xyz), CODE["unclassified"], np.uint8)
    classification[ground] = CODE["terrain"]
    above = np.flatnonzero(~ground & (height > 0))
    del ground
    if len(above) >= MIN_POINTS:
        report(0.1, "voxels")
        centre, voxel_index = _voxels(xyz[above], scale.voxel)
        count = np.bincount(voxel_index)
        mean_height = (np.bincount(voxel_index, height[above]) / count).astype(np.float32)
        if len(centre) >= MIN_POINTS:
            codes = _above_ground(centre, mean_height, count.astype(np.float64), scale, report)
            classification[above] = codes[voxel_index]
    report(1.0, "done")
    return classification


def _split_sparse(xyz: F32, voxel: float, spacing: float) -> tuple[F32, Bools, Scale]:
    """As `split_ground` for points that are `spacing` metres apart; and the scale of the points above ground.

    Merged sweeps with errors of their poses show the ground several times. The surface of its lowest points is below
    most of them: the range of heights in columns with nothing but ground measures by how much.
    """
    cell = max(GROUND_CELL_M, SPARSE_CELL_SPACINGS * spacing)
    tolerance = max(GROUND_TOLERANCE_M, SPARSE_TOLERANCE_SPACINGS * spacing)
    height, ground = split_ground(xyz, cell, tolerance)
    thickness = _ground_thickness(xyz, height, cell)
    if thickness > THICKNESS_MAX_M:
        thickness = 0.0
    if TOLERANCE_THICKNESSES * thickness > tolerance:
        tolerance = TOLERANCE_THICKNESSES * thickness
        height, ground = split_ground(xyz, cell, tolerance)
    noise = max(NOISE_OF_THICKNESS * thickness, _grid_noise(xyz))
    size = max(voxel, spacing, VOXEL_NOISES * noise)
    # NEIGHBOURS points, one per voxel, of a plane fill a disk; its variance along both axes is a quarter of r^2
    spread = NEIGHBOURS * size**2 / np.pi / 4
    few = max(SPARSE_MIN_POINTS, round(MIN_POINTS * (0.2 / size) ** 2)) if size > voxel else MIN_POINTS
    return height, ground, Scale(size, few, noise**2 / (noise**2 + 2 * spread))


def _grid_noise(xyz: F32) -> float:
    """Standard deviation in metres of points at the centres of voxels from the surface; 0 if they are not."""
    from scipy.spatial import cKDTree

    distance = cKDTree(xyz).query(xyz[:: max(1, len(xyz) // 20_000)], k=2, workers=-1)[0][:, 1]
    low, middle, high = np.percentile(distance, (25, 50, 75)).tolist()
    return middle / math.sqrt(12) if high - low < GRID_MAX_SPREAD * middle else 0.0


def _ground_thickness(xyz: F32, height: F32, cell: float) -> float:
    """Median over columns without high points of the range between the lowest point and the 90th percentile, metres."""
    at = np.floor((xyz[:, :2] - xyz[:, :2].min(axis=0)) / cell).astype(np.int64)
    key = at[:, 0] * (at[:, 1].max() + 1) + at[:, 1]
    order = np.lexsort((height, key))
    starts = np.flatnonzero(np.diff(key[order], prepend=-1))
    count = np.diff(np.append(starts, len(order)))
    sorted_height = height[order]
    is_open = (count >= THICKNESS_CELL_MIN_POINTS) & (sorted_height[starts + count - 1] < THICKNESS_OPEN_MAX_M)
    if not is_open.any():
        return 0.0
    upper = starts + np.ceil(0.9 * (count - 1)).astype(np.int64)
    return float(np.median((sorted_height[upper] - sorted_height[starts])[is_open]))


def split_ground(xyz: F32, cell: float = GROUND_CELL_M, tolerance: float = GROUND_TOLERANCE_M) -> tuple[F32, Bools]:
    """Height above ground (N,) in metres, and whether each point is ground.

    SMRF on a grid of the lowest points, with two additions: points far below their surroundings are
    rejected (multipath), and wide gaps without points are filled with low heights, so that a roof
    without measured ground around it still stands out.

    Args:
        xyz: (N, 3) points.
        cell: cell of the grid in metres.
        tolerance: distance in metres of ground points from the ground surface, where that is level.
    """
    from scipy import ndimage

    low = xyz[:, :2].min(axis=0)
    at = (xyz[:, :2] - low) / cell
    index = at.astype(np.int64)
    shape = tuple(index.max(axis=0) + 1)
    flat = np.ravel_multi_index((index[:, 0], index[:, 1]), shape)
    lowest = np.full(shape, np.inf, np.float32)
    np.minimum.at(lowest.reshape(-1), flat, xyz[:, 2])
    empty = ~np.isfinite(lowest)
    surface = _fill(lowest, empty)
    pit = ndimage.grey_closing(surface, size=(3, 3)) - surface > 0.5 + 5 * GROUND_MAX_SLOPE * cell
    in_gap = ndimage.distance_transform_edt(empty) * cell > GROUND_GAP_RADIUS_M if empty.any() else empty
    floor = ndimage.minimum_filter(ndimage.grey_closing(surface, size=(5, 5)), size=2 * int(GROUND_WINDOW_M / cell) + 1)
    surface = np.where(in_gap, floor, _fill(surface, pit))

    not_ground = empty | pit
    opened = surface
    for radius in _radii(round(GROUND_WINDOW_M / cell)):
        below = ndimage.grey_opening(opened, size=(2 * radius + 1,) * 2)
        not_ground |= opened - below > GROUND_MAX_SLOPE * radius * cell
        opened = below
    if not_ground.all():
        return np.zeros(len(xyz), np.float32), np.ones(len(xyz), bool)
    ground = ndimage.gaussian_filter(_fill(surface, not_ground), 1.0)
    rise = np.hypot(*(np.gradient(ground, cell, axis=k) if shape[k] > 1 else 0 * ground for k in (0, 1)))
    grid_position = (at - 0.5).T
    height = xyz[:, 2] - ndimage.map_coordinates(ground, grid_position, order=1, mode="nearest")
    slack = tolerance + cell * ndimage.map_coordinates(rise, grid_position, order=1, mode="nearest")
    return height.astype(np.float32), np.abs(height) < slack


def _radii(widest: int) -> list[int]:
    """Radii of the openings, in cells, each about a third wider than the last."""
    radii = [1]
    while radii[-1] < widest:
        radii.append(min(widest, max(radii[-1] + 1, int(radii[-1] * 1.3))))
    return radii


def _fill(grid: F32, holes: Bools) -> F32:
    """`grid` with its holes filled from the nearest other cell."""
    from scipy import ndimage

    if not holes.any():
        return grid
    nearest = ndimage.distance_transform_edt(holes, return_distances=False, return_indices=True)
    return grid[tuple(nearest)]


def _voxels(xyz: F32, size: float) -> tuple[F32, I64]:
    """Centroids (M, 3) of the occupied voxels, and each point's voxel (N,)."""
    cells = np.floor((xyz - xyz.min(axis=0)) / size).astype(np.int64)
    spans = cells.max(axis=0) + 1
    keys = (cells[:, 0] * spans[1] + cells[:, 1]) * spans[2] + cells[:, 2]
    del cells
    _, index, count = np.unique(keys, return_inverse=True, return_counts=True)
    centre = np.stack([np.bincount(index, xyz[:, k]) / count for k in range(3)], axis=1)
    return centre.astype(np.float32), index


def _above_ground(xyz: F32, height: F32, weight: F64, scale: Scale, report: Report) -> U8:
    report(0.2, "neighbourhoods")
    shape = describe(xyz, weight, NEIGHBOURS)
    report(0.6, "surfaces")
    classification = np.zeros(len(xyz), np.uint8)
    _buildings(classification, xyz, height, shape, scale)
    report(0.8, "poles and vehicles")
    rough = _mean(shape.variation, shape)
    _poles(classification, xyz, shape, scale)
    _vehicles(classification, xyz, height, shape, rough, scale)
    rest = classification == 0
    classification[rest & (rough > VEGETATION_MIN_VARIATION + scale.variation)] = CODE["high_vegetation"]
    report(0.9, "votes")
    _vote(classification, shape)
    plant = classification == CODE["high_vegetation"]
    classification[plant & (height < 2.0)] = CODE["mid_vegetation"]
    classification[plant & (height < 0.5)] = CODE["low_vegetation"]
    classification[classification == 0] = CODE["unclassified"]
    return classification


def describe(xyz: F32, weight: F64, k: int) -> Shape:
    """Shape of the neighbourhood of each point (M, 3): its `k` nearest points, weighted by `weight` (M,)."""
    from scipy.spatial import cKDTree

    n = len(xyz)
    k = min(k, n - 1)
    tree = cKDTree(xyz)
    near, gap = np.empty((n, k), np.int32), np.empty((n, k), np.float32)
    variation, linearity, upright = (np.empty(n, np.float32) for _ in range(3))
    normal = np.empty((n, 3), np.float32)
    for start in range(0, n, 200_000):
        some = slice(start, min(start + 200_000, n))
        distance, index = tree.query(xyz[some], k + 1, workers=-1)
        near[some], gap[some] = index[:, 1:], distance[:, 1:]
        around = xyz[index].astype(np.float64) - xyz[some, None]
        share = weight[index] / weight[index].sum(axis=1, keepdims=True)
        around -= share[:, None] @ around
        values, vectors = np.linalg.eigh((around * share[:, :, None]).transpose(0, 2, 1) @ around)
        total, largest = np.maximum(values.sum(axis=1), 1e-12), np.maximum(values[:, 2], 1e-12)
        variation[some] = values[:, 0] / total
        linearity[some] = (values[:, 2] - values[:, 1]) / largest
        normal[some] = vectors[:, :, 0]
        upright[some] = np.abs(vectors[:, 2, 2])
    return Shape(near, gap, variation, linearity, normal, upright)


def _mean(values: F32, shape: Shape) -> F32:
    """Mean over each point's neighbourhood."""
    return values[shape.near].mean(axis=1)


@dataclass(frozen=True)
class Parts:
    """Connected components of some of the points.

    Attributes:
        part: (M,) component of each point, -1 for points in none.
        low, high: (P, 3) bounding boxes.
        count: (P,) number of points.
    """

    part: I64
    low: F64
    high: F64
    count: I64

    @property
    def size(self) -> F64:
        """(P, 3) size along the axes in metres."""
        return self.high - self.low

    def total(self, values: npt.NDArray[Any]) -> F64:
        """(P,) sum of the values (M,) over each component."""
        inside = self.part >= 0
        return np.bincount(self.part[inside], values[inside], len(self.count)).astype(np.float64)

    def mean(self, values: npt.NDArray[Any]) -> F64:
        """(P,) mean of the values (M,) over each component."""
        return self.total(values) / np.maximum(self.count, 1)


def _parts(xyz: F32, member: Bools, a: I64, b: I64) -> Parts:
    """Connected components of the points that are `member`, with edges from `a` to `b`."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    n = len(xyz)
    edges = coo_matrix((np.ones(len(a), np.int8), (a, b)), shape=(n, n))
    _, part = connected_components(edges, directed=False)
    part = np.where(member, part, -1).astype(np.int64)
    _, part[member] = np.unique(part[member], return_inverse=True)
    return _boxes(xyz, part)


def _boxes(xyz: F32, part: I64) -> Parts:
    """Components numbered 0, 1, ... by `part` (-1 for none), with their bounding boxes."""
    count = np.bincount(part[part >= 0])
    if len(count) == 0:
        return Parts(part, np.empty((0, 3)), np.empty((0, 3)), count)
    order = np.argsort(part, kind="stable")[np.count_nonzero(part < 0) :]
    starts = np.cumsum(count) - count
    low = np.minimum.reduceat(xyz[order], starts).astype(np.float64)
    high = np.maximum.reduceat(xyz[order], starts).astype(np.float64)
    return Parts(part, low, high, count)


def _edges(shape: Shape, member: Bools, k: int, distance: float) -> tuple[I64, I64]:
    """Pairs of members among the first `k` neighbours, nearer than `distance` or three times the local spacing."""
    rows = np.flatnonzero(member)
    near, gap = shape.near[rows, :k], shape.gap[rows, :k]
    close = (gap < np.maximum(distance, 3 * gap[:, :1])) & member[near]
    return rows[np.nonzero(close)[0]], near[close].astype(np.int64)


def _buildings(classification: U8, xyz: F32, height: F32, shape: Shape, scale: Scale) -> None:
    """Classify large smooth surfaces, in place: high ones are buildings, long low upright ones walls."""
    smooth = shape.variation < SMOOTH_MAX_VARIATION + scale.variation
    a, b = _edges(shape, smooth, 8, 0.3 * scale.gap)
    same = np.abs(np.einsum("ni,ni->n", shape.normal[a], shape.normal[b])) > SURFACE_MIN_NORMAL_COS
    parts = _parts(xyz, smooth, a[same], b[same])
    k = shape.gap.shape[1]
    area = parts.total(np.pi * shape.gap[:, -1] ** 2 / k)
    top = _top(parts, height)
    tilt = parts.mean(np.abs(shape.normal[:, 2]))
    length = np.hypot(parts.size[:, 0], parts.size[:, 1])
    even = (parts.count >= scale.min_points) & (
        parts.mean(shape.variation) < BUILT_MAX_MEAN_VARIATION + scale.variation
    )
    if scale.gap > 1:
        even &= _curved(parts, xyz, scale.min_points) < SPARSE_MAX_CURVED + scale.variation
    building = even & (area > BUILDING_MIN_AREA_M2) & (top > BUILDING_MIN_HEIGHT_M)
    wall = even & (tilt < 0.3) & (length > WALL_MIN_LENGTH_M) & (top > WALL_MIN_HEIGHT_M) & ~building
    _assign(classification, parts, building, CODE["building"])
    _assign(classification, parts, wall, CODE["wall_or_fence"])
    # components attached to a building and to little else: edges, balconies, sparsely scanned walls
    attached = (classification[shape.near] == CODE["building"]).any(axis=1)
    parts = _parts(
        xyz, classification == 0, *_edges(shape, classification == 0, 8 if scale.gap == 1 else 4, 0.3 * scale.gap)
    )
    _assign(classification, parts, parts.mean(attached) > 0.5, CODE["building"])


def _poles(classification: U8, xyz: F32, shape: Shape, scale: Scale) -> None:
    """Classify thin upright lines, including tree trunks, as poles, in place."""
    line = (classification == 0) & (shape.linearity > 0.6) & (shape.upright > 0.9)
    parts = _parts(xyz, line, *_edges(shape, line, NEIGHBOURS, 0.4 * scale.gap))
    thin = (np.hypot(parts.size[:, 0], parts.size[:, 1]) < POLE_MAX_WIDTH_M) & (parts.size[:, 2] > POLE_MIN_HEIGHT_M)
    _assign(classification, parts, thin, CODE["pole"])


def _vehicles(classification: U8, xyz: F32, height: F32, shape: Shape, rough: F32, scale: Scale) -> None:
    """Classify compact components of a car's size that are smoother than bushes as vehicles, in place.

    Parked cars touch other objects near the ground, and tree crowns overhang them. They are separated
    in a band at the height of their doors; the points above and below are assigned to the nearest
    component in the band.
    """
    from scipy.spatial import cKDTree

    free = (classification == 0) & ~((shape.linearity > 0.5) & (shape.upright > 0.9))
    band = np.flatnonzero(free & (height > VEHICLE_BAND_M[0]) & (height < VEHICLE_BAND_M[1]))
    if len(band) == 0:
        return
    inside = np.zeros(len(classification), bool)
    inside[band] = True
    part = _parts(xyz, inside, *_edges(shape, inside, NEIGHBOURS, 0.3 * scale.gap)).part
    rest = np.flatnonzero(free & ~inside & (height < VEHICLE_HEIGHT_M[1]))
    gap, nearest = cKDTree(xyz[band, :2]).query(xyz[rest, :2], distance_upper_bound=0.3 * scale.gap)
    close = np.isfinite(gap)
    part[rest[close]] = part[band[nearest[close]]]
    parts = _boxes(xyz, part)
    length, width = _footprints(parts, xyz, scale.min_points)
    top = _top(parts, height)
    car = (length > VEHICLE_LENGTH_M[0]) & (length < VEHICLE_LENGTH_M[1]) & (top > VEHICLE_HEIGHT_M[0])
    car &= (
        (width > VEHICLE_WIDTH_M[0])
        & (width < VEHICLE_WIDTH_M[1])
        & (parts.mean(rough) < VEHICLE_MAX_VARIATION + scale.variation)
    )
    _assign(classification, parts, car, CODE["vehicle"])


def _top(parts: Parts, height: F32) -> F64:
    """(P,) largest height above ground of each component."""
    inside = parts.part >= 0
    top = np.zeros(len(parts.count))
    np.maximum.at(top, parts.part[inside], height[inside])
    return top


def _footprints(parts: Parts, xyz: F32, min_points: int) -> tuple[F64, F64]:
    """(P,) length and width in plan, along its principal axes, of each component of `min_points` or more."""
    length, width = np.zeros(len(parts.count)), np.zeros(len(parts.count))
    order = np.argsort(parts.part, kind="stable")
    ends = np.searchsorted(parts.part[order], np.arange(len(parts.count) + 1))
    for i in np.flatnonzero(parts.count >= min_points):
        xy = xyz[order[ends[i] : ends[i + 1]], :2].astype(np.float64)
        xy -= xy.mean(axis=0)
        along = xy @ np.linalg.eigh(xy.T @ xy)[1]
        low, high = np.percentile(along, (3, 97), axis=0)  # mixed pixels are outliers
        width[i], length[i] = np.sort(high - low)
    return length, width


def _curved(parts: Parts, xyz: F32, min_points: int) -> F64:
    """(P,) smallest eigenvalue over the sum of the covariance of each component's points; 1 below `min_points`."""
    curved = np.ones(len(parts.count))
    mean = np.stack([parts.mean(xyz[:, k]) for k in range(3)], axis=1)
    offset = xyz - mean[parts.part]
    large = parts.count >= min_points
    covariance = np.empty((len(parts.count), 3, 3))
    for i in range(3):
        for k in range(3):
            covariance[:, i, k] = parts.mean(offset[:, i] * offset[:, k])
    values = np.linalg.eigvalsh(covariance[large])
    curved[large] = values[:, 0] / np.maximum(values.sum(axis=1), 1e-12)
    return curved


def _assign(classification: U8, parts: Parts, selected: Bools, code: int) -> None:
    """Assign a class to the points of the `selected` (P,) components, in place."""
    inside = np.flatnonzero(parts.part >= 0)
    classification[inside[selected[parts.part[inside]]]] = code


def _vote(classification: U8, shape: Shape) -> None:
    """Majority vote among each point's neighbours, in place; poles and vehicles keep their class."""
    fixed = np.isin(classification, (CODE["pole"], CODE["vehicle"]))
    codes = np.unique(classification)
    for _ in range(VOTING_ROUNDS):
        best, most = classification.copy(), np.zeros(len(classification), np.int16)
        for code in codes:
            votes = (classification == code)[shape.near].sum(axis=1, dtype=np.int16) - (1 if code == 0 else 0)
            wins = votes > most
            best[wins], most[wins] = code, votes[wins]
        classification[~fixed] = best[~fixed]
