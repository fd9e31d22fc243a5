"""Occupancy maps of a world: where a robot can drive, from the collision mesh, one map for each storey.

1. The mesh becomes spans (`pipeline.simulation.spans`). Level spans are floor, whichever way their faces are oriented,
   unless something is in the robot's height band above them.
2. Floor cells whose heights differ by less than a step are connected. Connected floors are inside if the robot's path
   or the map's origin is above them, or if they are large and below a ceiling; a roof is neither.
3. Floors that lie above each other are separate storeys.
4. On each storey, floor that a robot of the given radius reaches is free; surfaces in the height band above the
   nearest such floor are occupied; the rest is unknown.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.types import F32, F64, I32, I64, U8, Bools, Mesh
from scan2sim.pipeline.simulation.spans import Grid, Spans, blocked, spans_of

FREE, OCCUPIED, UNKNOWN = 0, 1, 2
"""Values of a map."""
MAX_CELLS = 16_000_000
"""Larger grids get larger cells."""
MERGE_M = 0.12
"""Floors of a cell that are nearer than this are one (overlapping surfaces); the upper one counts."""
MIN_COVERED = 0.95
"""Share of a cell that must be floor: at its border a robot would fall."""
SAME_SURFACE_M = 0.02
"""Height difference, beyond that of the slope, of level faces that cover a cell together."""
HEADROOM_M = 8.0
"""Height above a floor within which a surface is its ceiling."""
SEED_HEIGHT_M = 3.0
"""Maximum height of the robot's path, or of the map's origin, above the floor below it."""
MIN_FLOOR_M2, MIN_FLOOR_SHARE = 4.0, 0.02
"""Smallest floor that is inside without a seed: its area, and as a share of the largest one."""
MIN_CEILING_SHARE = 0.5
MAX_OVERLAP_SHARE = 0.02
"""Floors that lie above each other in a smaller share of the cells are one storey."""
STOREY_MIN_HEIGHT_M = 1.8
HISTOGRAM_BIN_M = 0.1
MARGIN_M = 0.5
"""Margin of a map around its known cells."""
MAX_CORNER_M2 = 0.5
"""Largest connected floor that is free beside floor that the robot reaches, as in corners."""
EDGE_M = 0.2
"""Distance from where the floor ends without a wall, within which it is unknown."""
OCCUPIED_DISTANCE_M = 1.0
"""Distance from free cells up to which surfaces are occupied; what is beyond has a floor of unknown height."""


@dataclass(frozen=True)
class Band:
    """What a robot needs, metres.

    Attributes:
        low, high: heights above the floor between which surfaces are obstacles.
        step: largest height difference between neighbouring cells.
        slope: steepest floor, degrees.
        radius: half the width of the narrowest passage that it drives through.
    """

    low: float = 0.1
    high: float = 0.75
    step: float = 0.06
    slope: float = 30.0
    radius: float = 0.3


@dataclass(frozen=True)
class Storey:
    """Occupancy of a storey.

    Attributes:
        grid: its cells; coordinates are those of the mesh.
        occupancy: (Y, X) FREE, OCCUPIED or UNKNOWN, rows along y.
        floor: (Y, X) height of the floor, NaN where there is none.
    """

    grid: Grid
    occupancy: U8
    floor: F32

    @property
    def height(self) -> float:
        """Median height of its free floor."""
        return float(np.median(self.floor[self.occupancy == FREE]))

    @property
    def free(self) -> Bools:
        """(Y, X) whether a cell is free."""
        return self.occupancy == FREE

    @property
    def free_m2(self) -> float:
        """Free area."""
        return float(self.free.sum()) * self.grid.cell**2

    def clearance(self) -> F64:
        """(Y, X) distance from the centre of a cell to the nearest one that isn't free, metres."""
        from scipy.ndimage import distance_transform_edt

        return np.asarray(distance_transform_edt(np.pad(self.free, 1))[1:-1, 1:-1] * self.grid.cell)


def storeys(
    mesh: Mesh, seeds: F64, band: Band | None = None, cell: float = 0.05, ground: Bools | None = None
) -> list[Storey]:
    """Occupancy maps of a world's storeys: first the one in which the robot started, then the others from below.

    Args:
        mesh: the collision mesh, metres, z up.
        seeds: (N, 3) positions of the robot's sensor, the start first; they may be empty, or outside the world.
        band: what the robot needs.
        cell: side of a cell, metres; larger for worlds of over `MAX_CELLS`.
        ground: (F,) whether a face may be floor; None: every level one.

    Raises:
        DataError: there is no floor.
    """
    band = band or Band()
    grid = _grid(mesh, cell)
    spans = spans_of(mesh, grid)
    level, floor = _floors(mesh, spans, band, grid.cell, ground)
    if not len(floor):
        raise DataError("navigation", "the collision mesh has no level floor that a robot fits on", "Check the world")
    covered = np.zeros(grid.shape, bool)
    covered.ravel()[level] = True
    open_above = ~blocked(spans, level, floor + np.float32(band.low), floor + np.float32(band.high))
    level, floor = level[open_above], floor[open_above]
    if not len(floor):
        raise DataError("navigation", "there is no free floor", "Check the world, and navigation.low and .high")
    label = _connected(level, floor, grid, band.step)
    seed = _below(seeds, level, floor, grid)
    inside = _inside(spans, level, floor, label, label[seed], band, grid.cell)
    level, floor, label = level[inside], floor[inside], label[inside]
    start = float(floor[np.searchsorted(np.flatnonzero(inside), seed[0])]) if len(seed) else None
    found = []
    for members in _split_storeys(level, floor):
        own = level[members], floor[members]
        one = _storey(spans, grid, covered, *own, _below(seeds, *own, grid), band)
        if one is not None:
            found.append(one)
    if not found:
        raise DataError("navigation", "no passage is wide enough", "Lower navigation.radius, or check the world")
    found.sort(key=lambda one: one.height)
    first = (
        max(found, key=lambda one: one.free_m2) if start is None else min(found, key=lambda o: abs(o.height - start))
    )
    return [_cropped(one) for one in (first, *(one for one in found if one is not first))]


def _grid(mesh: Mesh, cell: float) -> Grid:
    """Grid around a mesh; its corner is a multiple of the cell."""
    low, high = mesh.vertices[:, :2].min(axis=0).astype(float), mesh.vertices[:, :2].max(axis=0).astype(float)
    cell = max(cell, float(np.sqrt(np.prod(np.maximum(high - low, cell)) / MAX_CELLS)))
    first = np.floor(low / cell) - 1
    columns, rows = (np.floor(high / cell) - first + 2).astype(int).tolist()
    return Grid((float(first[0] * cell), float(first[1] * cell)), cell, (rows, columns))


def _floors(mesh: Mesh, spans: Spans, band: Band, side: float, ground: Bools | None) -> tuple[I64, F32]:
    """Cells (N,) and heights (N,) of level surfaces that cover a cell, sorted by cell and height."""
    level = np.abs(mesh.face_normal[:, 2]) > np.cos(np.radians(band.slope))
    keep = (level if ground is None else level & ground)[spans.face]
    cell, height, area = spans.cell[keep], spans.high[keep], spans.area[keep]
    if not len(cell):
        return cell, height
    order = np.lexsort((height, cell))
    cell, height, area = cell[order], height[order], area[order]
    last = np.ones(len(cell), bool)  # of those in a cell that are nearer than MERGE_M to the next one
    last[:-1] = (cell[1:] != cell[:-1]) | (height[1:] - height[:-1] > MERGE_M)
    first = np.concatenate([[0], np.flatnonzero(last)[:-1] + 1])
    count = np.diff(np.append(first, len(cell)))
    one_surface = np.repeat(height[last], count) - height <= side * np.tan(np.radians(band.slope)) + SAME_SURFACE_M
    last &= np.repeat(np.add.reduceat(np.where(one_surface, area, 0), first) > MIN_COVERED, count)
    return cell[last], height[last]


def _connected(cell: I64, floor: F32, grid: Grid, step: float) -> I32:
    """(N,) label of the connected floor of each cell, sorted by cell and height."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    quantum = 0.001
    scale = int((floor.max() - floor.min()) / quantum) + 4 * int(step / quantum) + 2
    z = ((floor - floor.min()) / quantum).astype(np.int64) + int(step / quantum)
    key = cell * scale + z
    rows, columns = [], []
    for shift, valid in ((1, cell % grid.shape[1] < grid.shape[1] - 1), (grid.shape[1], np.ones(len(cell), bool))):
        lowest = (cell + shift) * scale + z - int(step / quantum)
        other = np.searchsorted(key, lowest)
        near = valid & (other < len(key))
        near[near] &= key[other[near]] <= lowest[near] + 2 * int(step / quantum)
        rows.append(np.flatnonzero(near))
        columns.append(other[near])
    i, j = np.concatenate(rows), np.concatenate(columns)
    graph = coo_matrix((np.ones(len(i), np.int8), (i, j)), shape=(len(key), len(key)))
    return np.asarray(connected_components(graph, directed=False)[1], np.int32)


def _below(seeds: F64, cell: I64, floor: F32, grid: Grid) -> I64:
    """Indices of the floor cells below positions (N, 3); positions without a floor below them are left out."""
    from scipy.spatial import cKDTree

    if not len(seeds) or not len(cell):
        return np.zeros(0, np.int64)
    # the nearest floor below: distances in plan view count, those in height hardly
    flat = np.array([1.0, 1.0, 0.1])
    some = seeds[:: max(1, len(seeds) // 2000)]
    centres = grid.centres(cell)
    radius = SEED_HEIGHT_M * flat[2] + grid.cell
    near = np.flatnonzero(
        ((centres > some[:, :2].min(axis=0) - radius) & (centres < some[:, :2].max(axis=0) + radius)).all(axis=1)
    )
    if not len(near):
        return near
    centres = np.column_stack([centres[near], floor[near]])
    distance, index = cKDTree(centres * flat).query((some - [0, 0, 0.3]) * flat, distance_upper_bound=radius)
    index = near[index[np.isfinite(distance)]]
    under = some[np.isfinite(distance), 2] - floor[index]
    return np.asarray(index[(under > -0.2) & (under < SEED_HEIGHT_M)], np.int64)


def _inside(spans: Spans, cell: I64, floor: F32, label: I32, seeds: I32, band: Band, side: float) -> Bools:
    """(N,) whether a floor cell belongs to a floor that is inside."""
    size = np.bincount(label)
    roofed = blocked(spans, cell, floor + np.float32(band.high), floor + np.float32(HEADROOM_M))
    ceiling = np.bincount(label, roofed) / size
    indoor = ceiling > MIN_CEILING_SHARE
    enough = size * side**2 >= MIN_FLOOR_M2
    keep = np.zeros(len(size), bool)
    keep[seeds] = True
    candidates = np.flatnonzero(enough & indoor)
    if len(candidates) and (not len(seeds) or indoor[seeds].any()):
        largest = size[candidates].max()
        keep[candidates[size[candidates] >= MIN_FLOOR_SHARE * largest]] = True
    if not keep.any():
        keep[size.argmax()] = True
    return np.asarray(keep[label])


def _split_storeys(cell: I64, floor: F32) -> list[Bools]:
    """Masks of the storeys: floors that lie above each other are separate."""
    _, first, count = np.unique(cell, return_index=True, return_counts=True)
    if (count > 1).sum() <= MAX_OVERLAP_SHARE * len(count):
        lowest = np.zeros(len(cell), bool)
        lowest[first] = True
        return [lowest]
    bottom = float(floor.min())
    histogram = np.bincount(((floor - bottom) / HISTOGRAM_BIN_M).astype(np.int64))
    smooth = np.convolve(np.pad(histogram, 2), np.ones(5), "valid")
    levels: list[int] = []
    while smooth.max() > 0.05 * len(floor):
        peak = int(smooth.argmax())
        levels.append(peak)
        smooth[
            max(0, peak - round(STOREY_MIN_HEIGHT_M / HISTOGRAM_BIN_M)) : peak
            + round(STOREY_MIN_HEIGHT_M / HISTOGRAM_BIN_M)
            + 1
        ] = 0
    heights = bottom + (np.sort(levels) + 0.5) * HISTOGRAM_BIN_M
    nearest = np.abs(floor[:, None] - heights).argmin(axis=1)
    masks = []
    for k in range(len(heights)):
        members = np.flatnonzero(nearest == k)
        mask = np.zeros(len(cell), bool)
        mask[members[np.unique(cell[members], return_index=True)[1]]] = True
        masks.append(mask)
    return masks


def _storey(spans: Spans, grid: Grid, covered: Bools, cell: I64, floor: F32, seed: I64, band: Band) -> Storey | None:
    """Occupancy of a storey with the given floor cells; None if nowhere is space for a robot.

    `covered` (Y, X): cells with any floor. Where it ends without a wall, a robot would fall.
    """
    from scipy.ndimage import binary_dilation, distance_transform_edt, label

    free = np.zeros(grid.shape, bool)
    free.ravel()[cell] = True
    height = np.full(grid.shape, np.nan, np.float32)
    height.ravel()[cell] = floor
    reach = distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1] * grid.cell
    parts, count = label(reach > band.radius, np.ones((3, 3)))
    if not count:
        return None
    size = np.bincount(parts.ravel(), minlength=count + 1)
    size[0] = 0
    keep = size * grid.cell**2 >= MIN_FLOOR_M2
    near = parts.ravel()[cell[seed]]
    keep[near[near > 0]] = True
    keep[size.argmax()] = True
    keep[0] = False
    connected, count = label(free)
    reached = np.zeros(count + 1, bool)
    reached[connected[keep[parts]]] = True
    floors, driven = reached[connected], distance_transform_edt(~keep[parts]) * grid.cell <= band.radius + grid.cell
    corners, _ = label(floors & ~driven)
    small = np.bincount(corners.ravel()) * grid.cell**2 <= MAX_CORNER_M2
    small[0] = False
    free = floors & driven | small[corners]
    distance, index = distance_transform_edt(~free, return_indices=True)
    base = height[tuple(index)]
    around = np.flatnonzero((~free & (distance * grid.cell <= OCCUPIED_DISTANCE_M)).ravel())
    above = base.ravel()[around]
    solid = blocked(spans, around, above + np.float32(band.low), above + np.float32(band.high))
    occupancy = np.full(grid.shape, UNKNOWN, np.uint8)
    occupancy[free] = FREE
    occupancy.ravel()[around[solid]] = OCCUPIED
    edge = binary_dilation(~covered, mask=occupancy != OCCUPIED, iterations=round(np.ceil(EDGE_M / grid.cell)))
    free &= ~edge
    if not free.any():
        return None
    occupancy[edge & (occupancy == FREE)] = UNKNOWN
    return Storey(grid, occupancy, np.where(free, height, np.nan).astype(np.float32))


def _cropped(storey: Storey) -> Storey:
    """The storey without unknown borders."""
    grid, margin = storey.grid, int(np.ceil(MARGIN_M / storey.grid.cell))
    known = storey.occupancy != UNKNOWN
    rows, columns = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
    top, left = max(0, int(rows[0]) - margin), max(0, int(columns[0]) - margin)
    window = slice(top, int(rows[-1]) + margin + 1), slice(left, int(columns[-1]) + margin + 1)
    occupancy = storey.occupancy[window]
    x, y = grid.origin
    shape = int(occupancy.shape[0]), int(occupancy.shape[1])
    moved = replace(grid, origin=(x + left * grid.cell, y + top * grid.cell), shape=shape)
    return Storey(moved, occupancy, storey.floor[window])
