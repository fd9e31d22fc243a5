"""Classes from shape alone, for clouds that come without any.

Ground by a morphological filter (SMRF: Pingel, Clarke, McBride, "An improved simple morphological
filter for the terrain classification of airborne LIDAR data", ISPRS J. 77, 2013); what stands above
it by the covariance of each point's neighbourhood (Demantke et al., "Dimensionality based scale
selection in 3D lidar point clouds", ISPRS Laser Scanning 2011): smooth surfaces that are large and
high are buildings, thin upright lines poles, compact smooth things of a car's size vehicles, and
what is rough vegetation.

What stands above ground is looked at in voxels' centroids, and their classes carried back to the points.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.step import Report, silent
from scan2sim.pipeline.core.types import F32, F64, I32, I64, U8, Bools, PointCloud

NEIGHBOURS = 20
FEW = 30  # points, fewer have no shape
# ground (SMRF; tolerances in metres)
CELL = 0.5
SLOPE = 0.15  # rise over run that ground may have at the scale of the opening
WINDOW = 45.0  # half the widest roof
GROUND_GAP = 0.2  # how far from the ground's surface its points may be, on level ground
BLIND = 5.0  # gaps wider than twice this are taken to be as low as what is around them
# surfaces
SMOOTH = 0.04  # surface variation, smallest eigenvalue over the sum, at any point of a smooth surface
EVEN = 0.018  # its mean over a surface that was built; smooth crowns are above
BEND = 0.95  # cosine between neighbouring normals on one surface
BUILDING_AREA, BUILDING_HEIGHT = 5.0, 2.2
WALL_LENGTH, WALL_HEIGHT = 6.0, 0.8
# things
VEHICLE_LENGTH, VEHICLE_WIDTH, VEHICLE_HEIGHT = (1.8, 6.5), (0.7, 3.0), (0.9, 2.6)
VEHICLE_VARIATION = 0.07
DOORS = (0.3, 1.2)  # heights at which a car is separate from kerbs and crowns
POLE_WIDTH, POLE_HEIGHT = 0.6, 1.5
ROUGH = 0.03
VOTES = 3


@dataclass(frozen=True)
class Shape:
    """Neighbourhoods of (M, 3) points.

    Attributes:
        near: (M, K) indices of the nearest points, nearest first, itself excluded.
        gap: (M, K) metres to them.
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


def classify(cloud: PointCloud, report: Report = silent, *, voxel: float = 0.2) -> U8:
    """(N,) LAS codes: terrain, low/mid/high vegetation, building, wall_or_fence, vehicle, pole, unclassified.

    Args:
        voxel: metres; what is above ground is looked at in this detail. A neighbourhood, some five
            voxels wide, should be large against the noise of merged sweeps and small against a car.
    """
    xyz = cloud.xyz
    if len(xyz) < FEW:
        return np.full(len(xyz), CODE["unclassified"], np.uint8)
    report(0.0, "ground")
    height, ground = split_ground(xyz)
    classification = np.full(len(xyz), CODE["unclassified"], np.uint8)
    classification[ground] = CODE["terrain"]
    above = np.flatnonzero(~ground & (height > 0))
    del ground
    if len(above) >= FEW:
        report(0.1, "voxels")
        centre, of = _voxels(xyz[above], voxel)
        count = np.bincount(of)
        tall = (np.bincount(of, height[above]) / count).astype(np.float32)
        if len(centre) >= FEW:
            classification[above] = _above_ground(centre, tall, count.astype(np.float64), report)[of]
    report(1.0, "done")
    return classification


def split_ground(xyz: F32) -> tuple[F32, Bools]:
    """Height above ground (N,) in metres, and whether each point is of the ground.

    SMRF on a grid of the lowest points, with two additions: what lies below its surroundings by far is
    no ground (multipath), and wide gaps without points are taken to be low, so that a roof with
    nothing measured around it is still seen to stand out.
    """
    from scipy import ndimage

    low = xyz[:, :2].min(axis=0)
    at = (xyz[:, :2] - low) / CELL
    index = at.astype(np.int64)
    shape = tuple(index.max(axis=0) + 1)
    flat = np.ravel_multi_index((index[:, 0], index[:, 1]), shape)
    lowest = np.full(shape, np.inf, np.float32)
    np.minimum.at(lowest.reshape(-1), flat, xyz[:, 2])
    empty = ~np.isfinite(lowest)
    surface = _fill(lowest, empty)
    pit = ndimage.grey_closing(surface, size=(3, 3)) - surface > 0.5 + 5 * SLOPE * CELL
    blind = ndimage.distance_transform_edt(empty) * CELL > BLIND if empty.any() else empty
    floor = ndimage.minimum_filter(ndimage.grey_closing(surface, size=(5, 5)), size=2 * int(WINDOW / CELL) + 1)
    surface = np.where(blind, floor, _fill(surface, pit))

    thing = empty | pit
    opened = surface
    for radius in _radii(round(WINDOW / CELL)):
        below = ndimage.grey_opening(opened, size=(2 * radius + 1,) * 2)
        thing |= opened - below > SLOPE * radius * CELL
        opened = below
    if thing.all():
        return np.zeros(len(xyz), np.float32), np.ones(len(xyz), bool)
    ground = ndimage.gaussian_filter(_fill(surface, thing), 1.0)
    rise = np.hypot(*(np.gradient(ground, CELL, axis=k) if shape[k] > 1 else 0 * ground for k in (0, 1)))
    here = (at - 0.5).T
    height = xyz[:, 2] - ndimage.map_coordinates(ground, here, order=1, mode="nearest")
    slack = GROUND_GAP + CELL * ndimage.map_coordinates(rise, here, order=1, mode="nearest")
    return height.astype(np.float32), np.abs(height) < slack


def _radii(widest: int) -> list[int]:
    """Radii of the openings, in cells, each about a third wider than the last."""
    radii = [1]
    while radii[-1] < widest:
        radii.append(min(widest, max(radii[-1] + 1, int(radii[-1] * 1.3))))
    return radii


def _fill(grid: F32, holes: Bools) -> F32:
    """`grid` with its holes taken from the nearest cell that is none."""
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
    _, of, count = np.unique(keys, return_inverse=True, return_counts=True)
    centre = np.stack([np.bincount(of, xyz[:, k]) / count for k in range(3)], axis=1)
    return centre.astype(np.float32), of


def _above_ground(xyz: F32, height: F32, weight: F64, report: Report) -> U8:
    report(0.2, "neighbourhoods")
    shape = describe(xyz, weight, NEIGHBOURS)
    report(0.6, "surfaces")
    classification = np.zeros(len(xyz), np.uint8)
    _buildings(classification, xyz, height, shape)
    report(0.8, "things")
    rough = _mean(shape.variation, shape)
    _poles(classification, xyz, shape)
    _vehicles(classification, xyz, height, shape, rough)
    rest = classification == 0
    classification[rest & (rough > ROUGH)] = CODE["high_vegetation"]
    report(0.9, "votes")
    _vote(classification, shape)
    plant = classification == CODE["high_vegetation"]
    classification[plant & (height < 2.0)] = CODE["mid_vegetation"]
    classification[plant & (height < 0.5)] = CODE["low_vegetation"]
    classification[classification == 0] = CODE["unclassified"]
    return classification


def describe(xyz: F32, weight: F64, k: int) -> Shape:
    """Shape of the `k` nearest neighbours of each of (M, 3) points."""
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
    """Connected parts of some of the points.

    Attributes:
        of: (M,) part of each point, -1 for points of none.
        low, high: (P, 3) bounding boxes.
        count: (P,) points.
    """

    of: I64
    low: F64
    high: F64
    count: I64

    @property
    def size(self) -> F64:
        """(P, 3) metres along the axes."""
        return self.high - self.low

    def total(self, values: npt.NDArray[Any]) -> F64:
        """(P,) sum of a value of each point over each part."""
        inside = self.of >= 0
        return np.bincount(self.of[inside], values[inside], len(self.count)).astype(np.float64)

    def mean(self, values: npt.NDArray[Any]) -> F64:
        """(P,) mean of a value of each point over each part."""
        return self.total(values) / np.maximum(self.count, 1)


def _parts(xyz: F32, member: Bools, a: I64, b: I64) -> Parts:
    """Connected parts of the points that are `member`, over edges `a`-`b` between them."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    n = len(xyz)
    edges = coo_matrix((np.ones(len(a), np.int8), (a, b)), shape=(n, n))
    _, of = connected_components(edges, directed=False)
    of = np.where(member, of, -1).astype(np.int64)
    _, of[member] = np.unique(of[member], return_inverse=True)
    return _boxes(xyz, of)


def _boxes(xyz: F32, of: I64) -> Parts:
    """Parts numbered 0, 1, ... by `of` (-1 for none), with their bounding boxes."""
    count = np.bincount(of[of >= 0])
    if len(count) == 0:
        return Parts(of, np.empty((0, 3)), np.empty((0, 3)), count)
    order = np.argsort(of, kind="stable")[np.count_nonzero(of < 0) :]
    starts = np.cumsum(count) - count
    low = np.minimum.reduceat(xyz[order], starts).astype(np.float64)
    high = np.maximum.reduceat(xyz[order], starts).astype(np.float64)
    return Parts(of, low, high, count)


def _edges(shape: Shape, member: Bools, k: int, reach: float) -> tuple[I64, I64]:
    """Pairs of neighbours (first `k`) that are members, nearer than `reach` or than three times the local spacing."""
    rows = np.flatnonzero(member)
    near, gap = shape.near[rows, :k], shape.gap[rows, :k]
    close = (gap < np.maximum(reach, 3 * gap[:, :1])) & member[near]
    return rows[np.nonzero(close)[0]], near[close].astype(np.int64)


def _buildings(classification: U8, xyz: F32, height: F32, shape: Shape) -> None:
    """Large smooth surfaces: high ones are buildings, long low upright ones walls."""
    smooth = shape.variation < SMOOTH
    a, b = _edges(shape, smooth, 8, 0.3)
    same = np.abs(np.einsum("ni,ni->n", shape.normal[a], shape.normal[b])) > BEND
    parts = _parts(xyz, smooth, a[same], b[same])
    k = shape.gap.shape[1]
    area = parts.total(np.pi * shape.gap[:, -1] ** 2 / k)
    top = _top(parts, height)
    tilt = parts.mean(np.abs(shape.normal[:, 2]))
    length = np.hypot(parts.size[:, 0], parts.size[:, 1])
    even = (parts.count >= FEW) & (parts.mean(shape.variation) < EVEN)
    building = even & (area > BUILDING_AREA) & (top > BUILDING_HEIGHT)
    wall = even & (tilt < 0.3) & (length > WALL_LENGTH) & (top > WALL_HEIGHT) & ~building
    _paint(classification, parts, building, CODE["building"])
    _paint(classification, parts, wall, CODE["wall_or_fence"])
    # what hangs on a building and on little else: edges, balconies, sparsely seen walls
    hangs = (classification[shape.near] == CODE["building"]).any(axis=1)
    parts = _parts(xyz, classification == 0, *_edges(shape, classification == 0, 8, 0.3))
    _paint(classification, parts, parts.mean(hangs) > 0.5, CODE["building"])


def _poles(classification: U8, xyz: F32, shape: Shape) -> None:
    """Thin upright lines, trunks of trees among them."""
    line = (classification == 0) & (shape.linearity > 0.6) & (shape.upright > 0.9)
    parts = _parts(xyz, line, *_edges(shape, line, NEIGHBOURS, 0.4))
    thin = (np.hypot(parts.size[:, 0], parts.size[:, 1]) < POLE_WIDTH) & (parts.size[:, 2] > POLE_HEIGHT)
    _paint(classification, parts, thin, CODE["pole"])


def _vehicles(classification: U8, xyz: F32, height: F32, shape: Shape, rough: F32) -> None:
    """Compact things of a car's size, smoother than bushes.

    Parked cars touch what is beside them near the ground and crowns overhang them, so they are found
    apart in a band at the height of their doors; what is above and below it follows.
    """
    from scipy.spatial import cKDTree

    free = (classification == 0) & ~((shape.linearity > 0.5) & (shape.upright > 0.9))
    band = np.flatnonzero(free & (height > DOORS[0]) & (height < DOORS[1]))
    if len(band) == 0:
        return
    inside = np.zeros(len(classification), bool)
    inside[band] = True
    of = _parts(xyz, inside, *_edges(shape, inside, NEIGHBOURS, 0.3)).of
    rest = np.flatnonzero(free & ~inside & (height < VEHICLE_HEIGHT[1]))
    gap, nearest = cKDTree(xyz[band, :2]).query(xyz[rest, :2], distance_upper_bound=0.3)
    close = np.isfinite(gap)
    of[rest[close]] = of[band[nearest[close]]]
    parts = _boxes(xyz, of)
    length, width = _footprints(parts, xyz)
    top = _top(parts, height)
    car = (length > VEHICLE_LENGTH[0]) & (length < VEHICLE_LENGTH[1]) & (top > VEHICLE_HEIGHT[0])
    car &= (width > VEHICLE_WIDTH[0]) & (width < VEHICLE_WIDTH[1]) & (parts.mean(rough) < VEHICLE_VARIATION)
    _paint(classification, parts, car, CODE["vehicle"])


def _top(parts: Parts, height: F32) -> F64:
    """(P,) largest height above ground of each part."""
    inside = parts.of >= 0
    top = np.zeros(len(parts.count))
    np.maximum.at(top, parts.of[inside], height[inside])
    return top


def _footprints(parts: Parts, xyz: F32) -> tuple[F64, F64]:
    """(P,) length and width of each part seen from above, along its principal axes."""
    length, width = np.zeros(len(parts.count)), np.zeros(len(parts.count))
    order = np.argsort(parts.of, kind="stable")
    ends = np.searchsorted(parts.of[order], np.arange(len(parts.count) + 1))
    for i in np.flatnonzero(parts.count >= FEW):
        xy = xyz[order[ends[i] : ends[i + 1]], :2].astype(np.float64)
        xy -= xy.mean(axis=0)
        along = xy @ np.linalg.eigh(xy.T @ xy)[1]
        low, high = np.percentile(along, (3, 97), axis=0)  # mixed pixels stray
        width[i], length[i] = np.sort(high - low)
    return length, width


def _paint(classification: U8, parts: Parts, chosen: Bools, code: int) -> None:
    inside = np.flatnonzero(parts.of >= 0)
    classification[inside[chosen[parts.of[inside]]]] = code


def _vote(classification: U8, shape: Shape) -> None:
    """Points take the class of most of their neighbours; poles and vehicles stay as they are."""
    fixed = np.isin(classification, (CODE["pole"], CODE["vehicle"]))
    codes = np.unique(classification)
    for _ in range(VOTES):
        best, most = classification.copy(), np.zeros(len(classification), np.int16)
        for code in codes:
            votes = (classification == code)[shape.near].sum(axis=1, dtype=np.int16) - (1 if code == 0 else 0)
            wins = votes > most
            best[wins], most[wins] = code, votes[wins]
        classification[~fixed] = best[~fixed]
