"""Walls of an indoor map as slabs with straight edges and openings, both sides.

Every run of wall points (`wall_lines`) becomes a slab from floor to ceiling. Points of both sides of a wall spread by
its thickness, those of one side by the noise only: the difference is the thickness. Openings are rectangles without
points: down to the floor where the floor continues through the wall, or with wall all around.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from scan2sim.pipeline.buildings.wall_lines import Run, columns, find_runs, refined, wall_noise
from scan2sim.pipeline.core.types import F32, F64, I32, I64, Bools


@dataclass(frozen=True)
class SlabModel:
    """Limits; lengths in metres."""

    thin: float = 0.03
    """Thickness of a wall of which one side was seen."""
    min_thickness: float = 0.05
    """Difference in spread from which both sides were seen."""
    cell: float = 0.1
    """Smallest cell of the raster on the wall."""
    points_per_cell: float = 4.0
    door: tuple[float, float] = (0.55, 1.6)
    """Smallest width and height of an opening down to the floor."""
    door_step: float = 0.08
    """Smallest length of a wall that is open or not."""
    door_density: float = 0.35
    """Share of a wall's usual points from which it is closed."""
    window: float = 0.4
    """Smallest side of other openings."""
    window_hidden: float = 0.3
    """Share of a window's area with furniture in front from which the wall is hidden there, not open."""
    front: float = 1.0
    """Distance from a wall within which furniture hides it."""
    corner: float = 0.45
    """Largest gap at a corner that is closed."""
    end_gap: float = 0.6
    """Largest gap to floor or ceiling that is closed anyway."""
    full_share: float = 0.3
    """Share of a wall's length that reaches most of the room's height, from which it ends at the ceiling."""
    full_height: float = 0.7


MODEL = SlabModel()


@dataclass(frozen=True)
class Wall:
    """A slab of a wall.

    Attributes:
        run: its line; `half` is half of its thickness.
        low, high: heights of its lower and upper edge, metres.
        openings: (O, 4) rectangles u0, u1, z0, z1: along the wall and in height.
        sides: number of sides that were seen, 1 or 2.
    """

    run: Run
    low: float
    high: float
    openings: F64
    sides: int


def fit_walls(points: F32, floor: F32, front: F32, low: float | None, high: float | None, spacing: float) -> list[Wall]:
    """Walls of a storey.

    Args:
        points: (N, 3) wall points.
        floor: (M, 3) floor points.
        front: (K, 3) points of furniture, which hides walls.
        low, high: heights of floor and ceiling, None: not seen.
        spacing: typical distance of neighbouring points, metres.
    """
    runs = wall_runs(points, spacing)
    if not runs:
        return []
    noise = wall_noise(runs)
    z = points[:, 2].astype(np.float64)
    bottom, top = (float(v) for v in np.percentile(z, (0.5, 99.5)))
    bottom, top = (bottom if low is None else low), (top if high is None else high)
    walls = []
    everything = np.concatenate([points, floor, front])
    for run in runs:
        beside = points[run.contains(points, 0.05)]
        if len(beside) < 30:
            continue
        thickness = 2 * (run.half - noise)
        two = thickness >= MODEL.min_thickness
        if not two:
            behind = -_seen_side(run, everything)
            shifted = run.offset + behind * MODEL.thin / 2
            body = replace(run, offset=shifted, half=MODEL.thin / 2)
        else:
            body = replace(run, half=thickness / 2)
        _, u = run.coordinates(beside)
        lower, upper = _ends(beside, u, run, bottom, top)
        walls.append(
            Wall(
                body, lower, upper, _openings(run, beside, floor, front, lower, upper, noise, spacing), 2 if two else 1
            )
        )
    return _cornered(walls)


def wall_runs(points: F32, spacing: float) -> list[Run]:
    """Lines of the walls of a storey, from its wall points (N, 3)."""
    if len(points) < 50:
        return []
    xy = points[:, :2].astype(np.float64)
    free = np.ones(len(points), bool)
    runs: list[Run] = []
    for run in find_runs(columns(points, spacing)):
        own = run.contains(xy)
        if (own & free).sum() < max(30.0, 0.25 * own.sum()):
            continue
        runs.append(refined(run, xy))
        free &= ~runs[-1].contains(xy, 0.05)
    return runs


def _seen_side(run: Run, xyz: F32) -> float:
    """1 if there is more of the room on the side of the normal, else -1."""
    d, u = run.coordinates(xyz)
    along = (u > run.start) & (u < run.end)
    count = [np.count_nonzero(along & (side * d > run.half + 0.1) & (side * d < run.half + 2.0)) for side in (-1, 1)]
    return 1.0 if count[1] >= count[0] else -1.0


def _ends(own: F32, u: F64, run: Run, bottom: float, top: float) -> tuple[float, float]:
    """Heights of a wall's lower and upper edge; those of the room if it ends near them."""
    z = own[:, 2].astype(np.float64)
    bins = max(1, round(run.length / 0.25))
    k = np.clip(((u - run.start) / run.length * bins).astype(np.int64), 0, bins - 1)
    highest, lowest = np.full(bins, -np.inf), np.full(bins, np.inf)
    np.maximum.at(highest, k, z)
    np.minimum.at(lowest, k, z)
    seen = np.isfinite(lowest)
    full = float((highest[seen] > bottom + MODEL.full_height * (top - bottom)).mean()) >= MODEL.full_share
    upper = top if full else min(top, float(np.quantile(highest[seen], 0.8)))
    lower = float(np.quantile(lowest[seen], 0.2))
    return (bottom if lower - bottom < MODEL.end_gap or full else lower), upper


def _openings(run: Run, own: F32, floor: F32, front: F32, low: float, high: float, noise: float, spacing: float) -> F64:
    """Rectangles (O, 4) of openings in a wall: u0, u1, z0, z1."""
    from scipy import ndimage

    _, u = run.coordinates(own)
    z = own[:, 2].astype(np.float64)
    cell = float(np.clip(np.sqrt(MODEL.points_per_cell * run.length * (high - low) / len(own)), MODEL.cell, 0.3))
    shape = max(1, round(run.length / cell)), max(1, round((high - low) / cell))
    size = run.length / shape[0], (high - low) / shape[1]

    def raster(along: F64, height: F64) -> F64:
        count = np.zeros(shape)
        i, j = np.floor((along - run.start) / size[0]).astype(int), np.floor((height - low) / size[1]).astype(int)
        inside = (i >= 0) & (i < shape[0]) & (j >= 0) & (j < shape[1])
        np.add.at(count, (i[inside], j[inside]), 1)
        return count

    count = raster(u, z)
    full = count >= max(1.0, 0.15 * float(np.median(count[count > 0])))
    solid = ndimage.binary_closing(np.pad(full, 2), np.ones((3, 3)))[2:-2, 2:-2]
    found = []
    for start, end, head in _doors(run, u, z, floor, low, high, spacing):
        edges = _edges(u, z, start, end, low, head, noise)
        if edges[1] - edges[0] >= MODEL.door[0]:
            found.append((*edges, low - 1.0, head))
        i0, i1 = (int(np.clip(round((at - run.start) / size[0]), 0, shape[0])) for at in (start, end))
        solid[i0:i1] = True
    # windows: empty, wall on all sides
    hidden = np.zeros(shape)
    if len(front):
        off, along = run.coordinates(front)
        near = (np.abs(off) > run.half) & (np.abs(off) < MODEL.front)
        hidden = raster(along[near], front[near, 2].astype(np.float64))
    label, _ = ndimage.label(~solid)
    for k, (rows, cols) in enumerate(ndimage.find_objects(label), start=1):
        empty = label[rows, cols] == k
        sides = rows.start > 0 and rows.stop < shape[0] and cols.start > 0
        if not sides or cols.stop == shape[1] or empty.mean() < 0.7 or min(
            empty.shape[0] * size[0], empty.shape[1] * size[1]) < MODEL.window:  # fmt: skip
            continue
        if (hidden[rows, cols] > 0).mean() > MODEL.window_hidden:
            continue
        found.append((
            run.start + rows.start * size[0], run.start + rows.stop * size[0],
            low + cols.start * size[1], low + cols.stop * size[1],
        ))  # fmt: skip
    return np.array(found).reshape(-1, 4)


def _doors(
    run: Run, u: F64, z: F64, floor: F32, low: float, high: float, spacing: float
) -> list[tuple[float, float, float]]:
    """Stretches of a wall with few points from the floor up, through which the floor continues: start, end, head.

    People who went through doors leave some points there.
    """
    from scipy import ndimage

    count = max(1, round(run.length / max(MODEL.door_step, 1.25 * spacing)))
    size = run.length / count
    k = np.clip(((u - run.start) / size).astype(np.int64), 0, count - 1)
    top = low + min(MODEL.door[1], 0.75 * (high - low))
    points = np.bincount(k[(z > low + 0.3) & (z < top)], minlength=count)
    if not points.any():
        return []
    few = points < MODEL.door_density * float(np.median(points[points > 0]))
    closed = ndimage.binary_closing(np.pad(few, 2), np.ones(3))[2:-2]
    passable = _passable(run, floor, size, count)
    found = []
    for a, b in _stretches(closed):
        if a == 0 or (b - a) * size < MODEL.door[0] or (passable is not None and passable[a:b].mean() < 0.3):
            continue
        inside = np.zeros(count, bool)
        inside[a:b] = True
        levels = np.arange(top, high + MODEL.cell, MODEL.cell)
        here, wall = (
            np.histogram(z[part[k]], levels)[0] / max(int(part.sum()), 1) for part in (inside, ~inside & ~closed)
        )
        lintel = np.flatnonzero((here > 0.4 * wall) & (wall > 0))
        found.append((run.start + a * size, run.start + b * size, float(levels[lintel[0]]) if len(lintel) else high))
    return found


def _passable(run: Run, floor: F32, size: float, count: int) -> Bools | None:
    """(count,) whether there is floor below the wall's middle and on both sides, along it; None without any floor."""
    if len(floor) < 50:
        return None
    d, u = run.coordinates(floor)
    k = np.floor((u - run.start) / size).astype(int)

    def count_between(low: float, high: float) -> I64:
        own = k[(d > low) & (d < high) & (k >= 0) & (k < count)]
        return np.bincount(own, minlength=count)

    core, beyond = max(0.5 * run.half, 0.06), run.half + 0.5
    sides = count_between(-beyond, -run.half), count_between(run.half, beyond)
    usual = float(np.median(np.maximum(*sides))) * core / (beyond - run.half)
    return np.asarray((count_between(-core, core) > max(0.5, 0.05 * usual)) & (sides[0] > 0) & (sides[1] > 0))


def _edges(u: F64, z: F64, start: float, end: float, low: float, head: float, noise: float) -> tuple[float, float]:
    """The sides of a door from the wall's points beside it, where their density falls to half.

    Points of the door's reveal are spread by the noise (half of its extent), half of them into the opening.
    """
    beside = (z > low + 0.2) & (z < head - 0.1)
    edges = []
    for at, side in ((start, -1.0), (end, 1.0)):
        x = side * (u[beside] - at)
        count, bounds = np.histogram(x, np.arange(-0.3, 0.825, 0.05))
        usual = float(np.median(count[-8:]))
        reached = np.flatnonzero(count > 0.5 * usual) if usual > 0 else np.zeros(0, int)
        edges.append(at + side * (float(bounds[reached[0]]) + 0.5 * noise if len(reached) else 0.0))
    return edges[0], edges[1]


def _stretches(flags: Bools) -> list[tuple[int, int]]:
    """First and end index of each stretch of True."""
    change = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    return [(int(a), int(b)) for a, b in change.reshape(-1, 2)]


def _cornered(walls: list[Wall]) -> list[Wall]:
    """The walls, each end moved to the wall that it meets."""
    moved = []
    for i, wall in enumerate(walls):
        run = wall.run
        ends = [run.start, run.end]
        for k, side in ((0, -1.0), (1, 1.0)):
            best = MODEL.corner
            for j, other in enumerate(walls):
                o = other.run
                cos = float(run.along @ o.normal)
                if j == i or abs(cos) < 0.5 or min(wall.high, other.high) - max(wall.low, other.low) < 0.5:
                    continue
                # u at which this wall's line crosses the other's
                at = (o.offset - run.offset * float(run.normal @ o.normal)) / cos
                cross = run.offset * run.normal + at * run.along
                v = float(cross @ o.along)
                if not o.start - MODEL.corner < v < o.end + MODEL.corner:
                    continue
                reach = abs(at - (run.start, run.end)[k])
                if reach < best:
                    best, ends[k] = reach, at + side * o.half / abs(cos)
        if ends[1] - ends[0] > 0.1:
            moved.append(replace(wall, run=replace(run, start=ends[0], end=ends[1])))
    return moved


def mesh_of(walls: Sequence[Wall]) -> tuple[F32, I32]:
    """Vertices (V, 3) and faces (F, 3) of slabs, counter-clockwise seen from outside."""
    vertices: list[F64] = [np.zeros((0, 3))]
    quads = 0
    for wall in walls:
        own = _quads(wall)
        run = wall.run
        xy = run.offset * run.normal + own[..., :1] * run.along + own[..., 1:2] * run.normal
        vertices.append(np.concatenate([xy, own[..., 2:]], axis=2).reshape(-1, 3))
        quads += len(own)
    faces = (4 * np.arange(quads)[:, None] + np.array([0, 1, 2, 0, 2, 3])).reshape(-1, 3)
    return np.concatenate(vertices).astype(np.float32), faces.astype(np.int32)


def _quads(wall: Wall) -> F64:
    """(Q, 4, 3) quadrilaterals (u, d, z) of a slab without its openings."""
    run = wall.run
    holes = [(max(a, run.start), min(b, run.end), max(c, wall.low), min(e, wall.high)) for a, b, c, e in wall.openings]
    holes = [hole for hole in holes if hole[0] < hole[1] and hole[2] < hole[3]]
    us = np.unique([run.start, run.end, *(v for hole in holes for v in hole[:2])])
    zs = np.unique([wall.low, wall.high, *(v for hole in holes for v in hole[2:])])
    u, z = (us[1:] + us[:-1]) / 2, (zs[1:] + zs[:-1]) / 2
    solid = np.ones((len(u), len(z)), bool)
    for a, b, c, e in holes:
        solid &= ~np.outer((u > a) & (u < b), (z > c) & (z < e))
    quads = []
    h = run.half
    for i0, i1, j0, j1 in rectangles(solid):
        a, b, c, e = us[i0], us[i1], zs[j0], zs[j1]
        quads.append([(a, h, c), (a, h, e), (b, h, e), (b, h, c)])
        quads.append([(a, -h, c), (b, -h, c), (b, -h, e), (a, -h, e)])
    padded = np.pad(solid, 1)
    for i in range(len(us)):
        for sign, edge in ((1, padded[i, 1:-1] & ~padded[i + 1, 1:-1]), (-1, ~padded[i, 1:-1] & padded[i + 1, 1:-1])):
            for j0, j1 in _stretches(edge):
                quad = [(us[i], -h, zs[j0]), (us[i], h, zs[j0]), (us[i], h, zs[j1]), (us[i], -h, zs[j1])]
                quads.append(quad if sign > 0 else quad[::-1])
    for j in range(len(zs)):
        for sign, edge in ((1, padded[1:-1, j] & ~padded[1:-1, j + 1]), (-1, ~padded[1:-1, j] & padded[1:-1, j + 1])):
            for i0, i1 in _stretches(edge):
                quad = [(us[i0], -h, zs[j]), (us[i1], -h, zs[j]), (us[i1], h, zs[j]), (us[i0], h, zs[j])]
                quads.append(quad if sign > 0 else quad[::-1])
    return np.array(quads, np.float64).reshape(-1, 4, 3)[:, ::-1]  # along, normal and up are left-handed


def rectangles(mask: Bools) -> list[tuple[int, int, int, int]]:
    """Rectangles (i0, i1, j0, j1) that cover a mask exactly, few and large ones."""
    left = mask.copy()
    found = []
    while left.any():
        height = np.zeros(left.shape[1], int)
        best: tuple[int, tuple[int, int, int, int]] = (0, (0, 0, 0, 0))
        for i in range(left.shape[0]):
            height = np.where(left[i], height + 1, 0)
            stack: list[tuple[int, int]] = []
            for j, h in enumerate([*height.tolist(), 0]):
                start = j
                while stack and stack[-1][1] >= h:
                    start, tall = stack.pop()
                    if tall * (j - start) > best[0]:
                        best = tall * (j - start), (i + 1 - tall, i + 1, start, j)
                stack.append((start, h))
        i0, i1, j0, j1 = best[1]
        left[i0:i1, j0:j1] = False
        found.append(best[1])
    return found
