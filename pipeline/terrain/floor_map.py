"""Floor map: the ground of a robot's map as height maps, one for each storey, without holes and spikes.

Heights come from points of the class terrain. Where there are none (scan shadows, removed objects, ground removed by a
filter), the floor is assumed: a membrane through its surroundings and the feet of walls or the sensor's path. A level
surface over another one is a storey of its own; treads of stairs belong to the storey that they start from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scan2sim.pipeline.core.types import F32, F64, I64, Bools
from scan2sim.pipeline.geometry.height_map import CELL_SIZES_M, Raster, close_gaps, dilate
from scan2sim.pipeline.terrain.assumed_floor import (
    complete,
    filtered_floor,
    median_sensor_height,
    near_floor,
    nearest_heights,
)
from scan2sim.pipeline.terrain.floor_limits import LIMITS, Storey
from scan2sim.pipeline.terrain.scanned_floor import scanned_heights


@dataclass(frozen=True)
class FloorMap:
    """The floor.

    Attributes:
        raster: the cells.
        storeys: from the lowest up.
        filtered: whether the ground is missing in the map, and the floor follows the feet of its walls or the path.
        sensor_height: height of the sensor over the floor in metres; None without a path.
    """

    raster: Raster
    storeys: tuple[Storey, ...]
    filtered: bool = False
    sensor_height: float | None = None

    @property
    def area(self) -> float:
        """Area in m2."""
        return float(sum(s.there.sum() for s in self.storeys)) * self.raster.cell**2

    @property
    def assumed_share(self) -> float:
        """Share of the area that is not scanned; 0 without floor."""
        cells = sum(int(s.there.sum()) for s in self.storeys)
        return sum(int((s.there & ~s.scanned).sum()) for s in self.storeys) / max(cells, 1)


def floor_map(
    ground: F32, others: F32, *, spacing: float, gap: float, level: bool, path: F32 | None = None
) -> FloorMap:
    """Find the floor of a map.

    Args:
        ground: (N, 3) points of the ground, metres, z up; may be empty.
        others: (M, 3) all other points: walls, ceilings, furniture.
        spacing: typical distance of neighbouring points, metres.
        gap: gaps narrower than twice this are closed, metres.
        level: whether floors consist of planes (buildings), to which heights are snapped.
        path: (K, 3) positions of the sensor, or None.
    """
    from scipy import ndimage

    parts = [part for part in (ground, others) if len(part)]
    if not parts:
        return FloorMap(Raster(CELL_SIZES_M[0], (0, 0), (1, 1)), ())
    raster = Raster.over(_cell_size(spacing, parts), parts)
    cell = raster.cell
    nodes = _column_heights(raster, ground)
    walls, foot = _wall_feet(raster, np.concatenate([ground, others]))
    if not walls.any():
        foot = raster.lowest(np.concatenate([ground, others]))
    open_ground = raster.covered(nodes) & ~walls if len(nodes) else np.zeros(raster.shape, bool)
    inside = ndimage.binary_fill_holes(close_gaps(open_ground | walls, gap / cell))
    filtered = not len(nodes) or float(open_ground.sum()) < LIMITS.filtered_share * min(
        float(inside.sum()), float(close_gaps(open_ground, gap / cell).sum()) * 2 + walls.sum()
    )
    if filtered:
        feet, sensor_height = filtered_floor(raster, nodes, foot, path)
        gap = gap if level else max(gap, LIMITS.filtered_gap)
        standing = np.concatenate([ground, others])  # the feet of walls pass for ground if nothing is below them
        storey = complete(raster, np.full(raster.shape, np.nan), feet, standing, path, gap, within_walls=level)
        return FloorMap(raster, (storey,), True, sensor_height)
    levels = _storey_levels(raster, nodes)
    storeys: list[Storey] = []
    sensor_height = None
    for k, low in enumerate(levels):
        high = levels[k + 1] - LIMITS.seam if k + 1 < len(levels) else np.inf
        start = low - 2 * LIMITS.seam if k else -np.inf
        mine = nodes[(nodes[:, 2] >= start) & (nodes[:, 2] < high)]
        top = levels[k + 1] - LIMITS.slab if k + 1 < len(levels) else np.inf
        scanned = scanned_heights(raster, mine, level)
        if not np.isfinite(scanned).any():
            continue
        feet = np.full(raster.shape, np.nan)
        if path is not None:
            own = path[(path[:, 2] > low) & (path[:, 2] < top)]
            known = nearest_heights(scanned)
            sensor_height = sensor_height or median_sensor_height(raster, own, scanned, known)
            if sensor_height is not None:
                feet[raster.at(own)] = own[:, 2] - sensor_height
        if k == 0:
            feet = np.where(np.isfinite(feet), feet, near_floor(foot, nearest_heights(scanned)))
        standing = others[(others[:, 2] < top) & (others[:, 2] > start)]
        closed = _openings(raster, storeys[-1], scanned, low, np.concatenate([ground, others])) if storeys else None
        climbs = scanned > low + LIMITS.headroom / 2 if k + 1 < len(levels) else None
        walked = path if k == 0 else None
        storeys.append(complete(raster, scanned, feet, standing, walked, gap, closed, climbs, within_walls=level))
    return FloorMap(raster, tuple(storeys), False, sensor_height)


def _cell_size(spacing: float, parts: Sequence[F32]) -> float:
    """The allowed cell size for a point spacing, or a larger one if there would be too many cells."""
    low, high = np.min([p.min(axis=0) for p in parts], axis=0), np.max([p.max(axis=0) for p in parts], axis=0)
    area = float(np.prod(high[:2] - low[:2] + 1))
    wanted = LIMITS.cell_spacings * spacing
    near = min(CELL_SIZES_M, key=lambda size: abs(np.log(size / max(wanted, CELL_SIZES_M[0]))))
    return next((s for s in CELL_SIZES_M if s >= near and area / s**2 < LIMITS.max_cells), CELL_SIZES_M[-1])


def _columns(raster: Raster, xyz: F32) -> tuple[I64, F64, I64]:
    """Cells (N,), flat, and heights (N,) of points, sorted by both, and the first point of each cell."""
    row, column = raster.at(xyz)
    cell = row * raster.shape[1] + column
    order = np.lexsort((xyz[:, 2], cell))
    cell = cell[order]
    return cell, xyz[order, 2].astype(np.float64), np.flatnonzero(np.diff(cell, prepend=-1))


def _column_heights(raster: Raster, ground: F32) -> F64:
    """Centres and heights (K, 3) of the surfaces in each column: several, if there are some above each other."""
    if not len(ground):
        return np.zeros((0, 3))
    cell, z, _ = _columns(raster, ground)
    first = np.flatnonzero((np.diff(cell, prepend=-1) != 0) | (np.diff(z, prepend=-np.inf) > LIMITS.cluster_gap))
    last = np.append(first[1:], len(z)) - 1
    tall = z[last] - z[first] > LIMITS.wall_extent
    height = z[np.where(tall, first + (last - first) // 5, (first + last) // 2)]
    row, column = np.divmod(cell[first], raster.shape[1])
    centre = (np.column_stack([column, row]) + raster.low + 0.5) * raster.cell
    return np.column_stack([centre, height])


def _wall_feet(raster: Raster, xyz: F32) -> tuple[Bools, F64]:
    """Cells with walls (points over each other), and the height of their lowest point (NaN elsewhere)."""
    walls, foot = np.zeros(raster.shape, bool), np.full(raster.shape, np.nan)
    if len(xyz):
        cell, z, first = _columns(raster, xyz)
        last = np.append(first[1:], len(z)) - 1
        gaps = np.diff(z, prepend=z[0])
        gaps[first] = 0
        dense = np.maximum.reduceat(np.where(gaps > LIMITS.wall_height, 1, 0), first) == 0  # no floor below a ceiling
        wall = (z[last] - z[first] > LIMITS.wall_height) & (last - first >= 2) & dense
        walls.ravel()[cell[first[wall]]] = True
        foot.ravel()[cell[first[wall]]] = z[first[wall]]
    return walls, foot


def _storey_levels(raster: Raster, nodes: F64) -> list[float]:
    """Heights of the floors, from the lowest up: several only if there is floor above floor."""
    row, column = raster.at(nodes)
    cell = row * raster.shape[1] + column
    order = np.lexsort((nodes[:, 2], cell))
    same = cell[order[1:]] == cell[order[:-1]]
    stacked = same & (np.diff(nodes[order, 2]) > LIMITS.headroom)
    least = max(LIMITS.min_storey, LIMITS.min_storey_share * len(nodes) * raster.cell**2)
    if stacked.sum() * raster.cell**2 < least:
        return [float(nodes[:, 2].min())]
    z = nodes[:, 2]
    width = 0.1
    count = np.bincount(((z - z.min()) / width).astype(np.int64)).astype(np.float64)
    count = np.convolve(count, [1, 1, 1], "same")
    levels: list[float] = []
    while count.max() * raster.cell**2 >= least:
        top = int(count.argmax())
        levels.append(float(z.min() + (top + 0.5) * width))
        away = round(LIMITS.headroom / width)
        count[max(0, top - away) : top + away + 1] = 0
    return sorted(levels)


def _openings(raster: Raster, below: Storey, scanned: F64, level: float, xyz: F32) -> Bools:
    """Cells of an upper storey without floor: the stairwell. Elsewhere a floor, its slab or a ceiling was seen."""
    from scipy import ndimage

    stairs = below.there & (below.height > level - LIMITS.headroom)
    slab = xyz[(xyz[:, 2] > level - LIMITS.slab) & (xyz[:, 2] < level + 0.1)]
    covered = close_gaps(raster.covered(slab) if len(slab) else np.zeros(raster.shape, bool), 0.3 / raster.cell)
    part, _ = ndimage.label(~(covered | np.isfinite(scanned)))
    touching = np.unique(part[dilate(stairs, 1.5)])
    open_ = np.isin(part, touching[touching > 0]) | stairs
    return np.asarray(open_ & ~close_gaps(np.isfinite(scanned), LIMITS.well_gap / raster.cell), bool)
