"""Ghosts in a map: trails of people and vehicles that moved while it was recorded.

A SLAM map adds up all its sweeps, so somebody who walks by becomes a row of upright clusters, or a single long one, as
wide as a person. Such a trail differs from static objects: the floor was seen beneath it, nothing is above it, it is
wider than a fence, and it is too long for a piece of furniture. Without the sweeps this is evidence and no proof, so
ghosts are proposed, not removed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from scan2sim.pipeline.core.types import F32, F64, I64, Bools

Kind = Literal["person", "vehicle"]


@dataclass(frozen=True)
class GhostShape:
    """Limits of a trail, in metres.

    Attributes:
        length_min: along its path.
        width: least and greatest width.
        top: least and greatest height of its upper end above the floor.
        window: radius within which the width is measured.
    """

    length_min: float
    width: tuple[float, float]
    top: tuple[float, float]
    window: float


SHAPES: dict[Kind, GhostShape] = {
    "vehicle": GhostShape(9.0, (1.2, 3.5), (1.1, 2.2), 1.75),
    "person": GhostShape(2.5, (0.25, 1.2), (1.3, 2.1), 1.2),
}
"""A vehicle's trail is longer than a parked vehicle."""


@dataclass(frozen=True)
class GhostModel:
    """Limits; lengths in metres, heights above the floor."""

    cell: float = 0.15
    """Side of the cells of the plan."""
    cell_spacings: float = 1.5
    """The same as a multiple of the spacing, if that is more."""
    cells_max: int = 2**24
    """Number of cells from which they become larger."""
    floor_cell: float = 0.5
    floor_noise: float = 0.1
    """Height up to which points belong to the floor."""
    storey_gap: float = 1.8
    """Least height between the floors of two storeys."""
    body: tuple[float, float] = (0.25, 2.3)
    """Heights of a trail's points."""
    clear: tuple[float, float] = (2.3, 2.8)
    """Heights that are empty above a trail; ceilings don't count."""
    link: float = 1.2
    """Distance between two clusters of one trail: who walks at 1.2 m/s is seen once per second."""
    floor_share_min: float = 0.95
    """Least share of a trail's cells beneath which the floor was seen."""
    column_points: int = 6
    """Least number of points of a column and its neighbours; fewer are noise."""
    span_min: float = 0.7
    """Vertical extent of a column and its neighbours."""
    around: float = 0.6
    """Distance up to which the free floor is compared with the floor beneath a column."""
    beside_max: float = 0.45
    """Largest share of a cluster's cells that adjoin static objects."""
    top_tolerance: float = 0.15
    """Height by which a single cluster may exceed the limit of a trail, through noise or a door's lintel."""
    margin: float = 0.2
    """Distance from a trail's cells within which points above the floor are part of it."""


MODEL = GhostModel()


class Ghost(NamedTuple):
    """A proposed ghost.

    Attributes:
        kind: what its width suggests.
        points: (N,) indices of its points.
        path: (M, 3) positions on the floor from one end to the other, metres.
        length, width, height: metres.
        floor_share: share of its cells beneath which the floor was seen.
    """

    kind: Kind
    points: I64
    path: F64
    length: float
    width: float
    height: float
    floor_share: float


def find_ghosts(xyz: F32, is_floor: Bools, is_wall: Bools, is_ceiling: Bools, spacing: float) -> list[Ghost]:
    """Trails of people and vehicles in a level map, longest first; none if the map has no floor.

    Args:
        xyz: (N, 3) metres, z up.
        is_floor: (N,) points of the floor or ground.
        is_wall: (N,) points of walls and buildings.
        is_ceiling: (N,) points of ceilings.
        spacing: of the points, metres.
    """
    found: list[Ghost] = []
    for level in _levels(xyz[is_floor, 2]):
        on = is_floor & (xyz[:, 2] >= level[0]) & (xyz[:, 2] < level[1])
        found += _ghosts_of_storey(xyz, on, is_wall, is_floor | is_ceiling, spacing)
    return sorted(found, key=lambda ghost: -ghost.length)


def _levels(floor_z: F32) -> list[tuple[float, float]]:
    """Height ranges of the storeys' floors: runs of heights without a gap of a storey."""
    if not len(floor_z):
        return []
    z = np.sort(floor_z.astype(np.float64))
    z = z[int(0.001 * len(z)) : len(z) - int(0.001 * len(z))]
    ends = np.flatnonzero(np.diff(z) > MODEL.storey_gap)
    low, high = np.append(z[0], z[ends + 1]), np.append(z[ends], z[-1])
    return [(a - 0.1, b + 0.1) for a, b in zip(low, high, strict=True)]


def _ghosts_of_storey(xyz: F32, on_floor: Bools, is_wall: Bools, ignored: Bools, spacing: float) -> list[Ghost]:
    """Ghosts over the floor points `on_floor` among the points that are not `ignored`."""
    from scipy import ndimage

    floor = _FloorHeight(xyz[on_floor].astype(np.float64))
    height = xyz[:, 2] - floor.at(xyz[:, :2])
    other = np.flatnonzero(~ignored & ~is_wall & (height > MODEL.floor_noise) & (height < MODEL.clear[1]))
    extent = np.ptp(xyz[:, :2], axis=0).astype(np.float64)
    cell = max(MODEL.cell, MODEL.cell_spacings * spacing, float(np.sqrt(extent.prod() / MODEL.cells_max)))
    low = xyz[:, :2].min(axis=0).astype(np.float64) - 2 * cell
    shape = tuple(np.ceil((xyz[:, :2].max(axis=0) - low) / cell).astype(int) + 3)
    place = np.floor((xyz[:, :2] - low) / cell).astype(np.int64)

    def grid_of(index: I64) -> Bools:
        grid = np.zeros(shape, bool)
        grid[tuple(place[index].T)] = True
        return grid

    body = other[(height[other] > MODEL.body[0]) & (height[other] < MODEL.body[1])]
    above = grid_of(other[height[other] > MODEL.clear[0]])
    top = np.full(shape, -np.inf)
    np.maximum.at(top, tuple(place[body].T), height[body])
    bottom, count = np.full(shape, np.inf), np.zeros(shape)
    np.minimum.at(bottom, tuple(place[body].T), height[body])
    np.add.at(count, tuple(place[body].T), 1.0)
    span = ndimage.maximum_filter(top, 3) - ndimage.minimum_filter(bottom, 3)
    columns = (ndimage.uniform_filter(count, 3, mode="constant") * 9 >= MODEL.column_points) & (span >= MODEL.span_min)
    bodies = grid_of(body) & columns
    seen = _floor_ratio(grid_of(np.flatnonzero(on_floor)), bodies, max(2, round(MODEL.around / cell)))
    steps = max(1, round(MODEL.margin / cell))
    standing = ndimage.binary_dilation(
        above | grid_of(np.flatnonzero(is_wall & (height > MODEL.floor_noise))), np.ones((3, 3))
    )
    upright = _isolated(bodies & ~standing, standing, seen, top)
    found = []
    for cells in _linked(upright, round(MODEL.link / cell / 2)):
        ghost = _measured(cells, top, seen, cell)
        if ghost is None:
            continue
        near = np.zeros(shape, bool)
        near[tuple(cells.T)] = True
        near = ndimage.binary_dilation(near, iterations=steps)
        near &= ~standing
        points = other[near[tuple(place[other].T)] & (height[other] < MODEL.body[1])]
        path = low + (ghost.path[:, :2] + 0.5) * cell
        found.append(ghost._replace(points=points, path=np.column_stack([path, floor.at(path)])))
    return found


def _isolated(mask: Bools, standing: Bools, seen: F64, top: F64) -> Bools:
    """The clusters of cells that are as high as a person or vehicle, over seen floor, and apart from static objects."""
    from scipy import ndimage

    label, count = ndimage.label(mask, np.ones((3, 3)))
    if not count:
        return mask
    border = ndimage.binary_dilation(standing, np.ones((3, 3)))
    index = np.arange(1, count + 1)
    beside = ndimage.mean(border, label, index)
    floor = ndimage.mean(seen, label, index)
    height = ndimage.labeled_comprehension(top, label, index, lambda tops: np.percentile(tops, 90), float, 0.0)
    low, high = min(shape.top[0] for shape in SHAPES.values()), max(shape.top[1] for shape in SHAPES.values())
    kept = (
        (beside <= MODEL.beside_max)
        & (floor >= MODEL.floor_share_min)
        & (height >= low)
        & (height <= high + MODEL.top_tolerance)
    )
    return np.append(False, kept)[label]


def _floor_ratio(seen: Bools, bodies: Bools, radius: int) -> F64:
    """How densely the floor was seen in each cell's neighbourhood beneath bodies, relative to the free floor around."""
    from scipy import ndimage

    def local_share(of: Bools, within: Bools, size: int) -> F64:
        total = ndimage.uniform_filter((of & within).astype(np.float64), size, mode="constant")
        weight = ndimage.uniform_filter(within.astype(np.float64), size, mode="constant")
        return np.asarray(np.divide(total, weight, out=np.zeros_like(total), where=weight > 1e-9))

    beneath, around = local_share(seen, bodies, 3), local_share(seen, ~bodies, 2 * radius + 1)
    return np.minimum(np.divide(beneath, around, out=np.zeros_like(beneath), where=around > 0.05), 1.0)


class _FloorHeight:
    """Height of the floor: that of the nearest cell with floor points, their median."""

    def __init__(self, floor: F64) -> None:
        """From the points (N, 3) of the floor."""
        from scipy.spatial import cKDTree

        cells, which = np.unique(np.floor(floor[:, :2] / MODEL.floor_cell), axis=0, return_inverse=True)
        order = np.lexsort((floor[:, 2], which))
        count = np.bincount(which)
        start = np.append(0, np.cumsum(count)[:-1])
        self._median = floor[order[start + count // 2], 2]
        self._tree = cKDTree((cells + 0.5) * MODEL.floor_cell)

    def at(self, xy: F32 | F64) -> F64:
        """(N,) heights at positions (N, 2)."""
        return np.asarray(self._median[self._tree.query(xy)[1]])


def _linked(mask: Bools, radius: int) -> Iterator[I64]:
    """(M, 2) cells of each cluster; gaps of up to twice the radius (in cells) are bridged."""
    from scipy import ndimage

    disc = np.hypot(*np.mgrid[-radius : radius + 1, -radius : radius + 1]) <= radius
    label, count = ndimage.label(ndimage.binary_dilation(mask, disc) if radius else mask, np.ones((3, 3)))
    cells = np.argwhere(mask)
    of = label[tuple(cells.T)]
    order = np.argsort(of, kind="stable")
    yield from np.split(cells[order], np.flatnonzero(np.diff(of[order])) + 1) if count else ()


def _measured(cells: I64, top: F64, seen: F64, cell: float) -> Ghost | None:
    """The ghost of a cluster of cells, its path in cells; None if it is none."""
    floor_share = float(seen[tuple(cells.T)].mean())
    height = float(np.percentile(top[tuple(cells.T)], 90))
    path, length = _longest_path(cells, MODEL.link / cell)
    for kind, shape in SHAPES.items():
        width = cell * _width(cells, shape.window / cell)
        fits = shape.top[0] <= height <= shape.top[1] and shape.width[0] <= width <= shape.width[1]
        if fits and cell * length >= shape.length_min and floor_share >= MODEL.floor_share_min:
            return Ghost(kind, np.zeros(0, np.int64), path, cell * length, width, height, floor_share)
    return None


def _longest_path(cells: I64, link: float) -> tuple[F64, float]:
    """(M, 2) shortest path between the two cells of a cluster that are farthest apart, and its length, in cells."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import dijkstra
    from scipy.spatial import cKDTree

    coarse = np.unique(np.round(cells / 2), axis=0) * 2
    pairs = cKDTree(coarse).query_pairs(link + 2, output_type="ndarray")
    distance = np.linalg.norm(coarse[pairs[:, 0]] - coarse[pairs[:, 1]], axis=1)
    graph = coo_matrix((distance, tuple(pairs.T)), (len(coarse), len(coarse))).tocsr()
    far = dijkstra(graph, directed=False, indices=0)
    end = int(np.argmax(np.where(np.isfinite(far), far, -1)))
    far, before = dijkstra(graph, directed=False, indices=end, return_predecessors=True)
    at = int(np.argmax(np.where(np.isfinite(far), far, -1)))
    length, path = float(far[at]), [at]
    while before[at] >= 0:
        at = int(before[at])
        path.append(at)
    return coarse[path], length


def _width(cells: I64, radius: float) -> float:
    """Median width of a cluster, in cells: of the cells within `radius`, across their main direction.

    A uniform distribution of a width w has a standard deviation of w / sqrt(12).
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(cells)
    sample = cells[:: max(1, len(cells) // 200)]
    widths = []
    for near in tree.query_ball_point(sample, radius):
        spread = np.cov(cells[near].T, bias=True) if len(near) > 1 else np.zeros((2, 2))
        widths.append(np.sqrt(12 * max(np.linalg.eigvalsh(spread)[0], 0.0) + 1))
    return float(np.median(widths))
