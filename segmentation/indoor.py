"""Classes of an indoor map's points: floor, wall, ceiling, stairs, furniture, people.

Floors and ceilings are levels at which much of the plan has points; walls are straight runs of columns that reach the
top of their storey (`pipeline.buildings.wall_lines`), as do pillars; stairs are sloping regions of regular treads;
people who walked through leave trails below which the floor was seen; the rest is furniture. Each of them may be
missing: a filter removed the ground, or the sensor doesn't see the ceiling.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from scan2sim.pipeline.buildings.storeys import Storey, find_storeys
from scan2sim.pipeline.buildings.wall_lines import Run, columns, find_runs, refined, wall_noise
from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.step import Report, silent
from scan2sim.pipeline.core.types import F32, F64, I64, U8, Bools


@dataclass(frozen=True)
class IndoorModel:
    """Limits; lengths in metres."""

    reach: float = 0.82
    """Share of a room's height that walls and pillars reach."""
    reach_share: float = 0.3
    """Share of a wall's length at which they do."""
    long_wall: float = 2.5
    """Length from which a run of half a room's height is a wall, too."""
    floor_share: float = 0.75
    """Share of a run's length with floor below it from which it is no wall but the trail of something that moved."""
    floor_density: float = 0.5
    floor_points: float = 2.5
    """Points of the floor in a column from which their absence means something."""
    ankle: float = 0.3
    chest: float = 1.1
    """Heights between which the trail of a person is filled."""
    trail_share: float = 0.8
    """Share of the plan of a trail in which the floor was seen."""
    person: float = 2.05
    """Height that no trail of a person exceeds,"""
    person_share: float = 0.2
    """except on this share of its length, where it crosses a wall,"""
    person_points: int = 4
    """and for outliers: fewer points on 25 cm."""
    wall_margin: float = 0.1
    """Distance from a wall's points within which others are its noise."""
    furniture_depth: float = 0.45
    """Distance from a wall within which furniture hides it."""
    furniture_points: float = 8.0
    """Number of points in front of a wall, on a square of its face, from which they may hide it."""
    hidden_shift: float = 0.025
    """Distance from the face of a wall to points that hide it."""
    hidden_depth: float = 0.01
    """Depth behind the face of a wall from which points of a hidden part are those of its other side."""
    two_sided: float = 0.05
    """Thickness from which both sides of a wall were seen."""
    outside_share: float = 0.1
    """Points on one side of a wall, as share of those on the other, up to which it is the building's outside."""
    reveal: float = 0.35
    """Depth of windows behind the face of an outer wall."""
    max_pillar: float = 1.5
    """Largest width of a pillar."""
    narrow_pillar: float = 0.85
    min_pillar: float = 1.1
    pillar_share: float = 0.75
    """Height of a narrow pillar, as share of that at which walls within `pillar_walls` were seen."""
    pillar_walls: float = 3.0
    stair_slope_deg: tuple[float, float] = (20.0, 50.0)
    stair_height: float = 1.2
    stair_tolerance: float = 0.14
    stair_crowd: float = 0.4
    """Points above or below a flight of stairs, as share of its own, from which it is none."""


MODEL = IndoorModel()


class Indoor(NamedTuple):
    """Result: LAS codes (N,), confidence (N,) (255: certain), storeys and walls."""

    classification: U8
    confidence: U8
    storeys: list[Storey]
    walls: list[list[Run]]


def classify_indoor(xyz: F32, spacing: float, report: Report = silent) -> Indoor:
    """Classify the points (N, 3) of a level map, metres, z up.

    Args:
        xyz: points.
        spacing: typical distance of neighbouring points, metres.
        report: receives progress.
    """
    n = len(xyz)
    code = np.full(n, CODE["furniture"], np.uint8)
    confidence = np.full(n, 150, np.uint8)
    storeys = find_storeys(xyz, spacing)
    walls = []
    for i, storey in enumerate(storeys):
        report(0.1 + 0.9 * i / len(storeys), f"storey {i + 1} of {len(storeys)}")
        own = np.flatnonzero((xyz[:, 2] >= storey.low) & (xyz[:, 2] < storey.high))
        found, sure, runs = _classify_storey(xyz[own], spacing, storey)
        code[own], confidence[own] = found, sure
        walls.append(runs)
    return Indoor(code, confidence, storeys, walls)


def _classify_storey(xyz: F32, spacing: float, storey: Storey) -> tuple[U8, U8, list[Run]]:
    """Classes and confidence (N,) of a storey's points, and its walls."""
    n = len(xyz)
    code, sure = np.full(n, CODE["furniture"], np.uint8), np.full(n, 150, np.uint8)
    if not n:
        return code, sure, []
    z = xyz[:, 2].astype(np.float64)
    bottom, top = (float(v) for v in np.percentile(z, (1, 99)))
    height = storey.floor.height(xyz) if storey.floor else z - bottom
    on_floor = np.abs(height) < storey.floor.tolerance if storey.floor else np.zeros(n, bool)
    under_floor = (height < -storey.floor.tolerance) if storey.floor else np.zeros(n, bool)
    on_ceiling = np.zeros(n, bool)
    over = np.zeros(n, bool)
    for ceiling in storey.ceilings:
        on_ceiling |= np.abs(ceiling.height(xyz)) < ceiling.tolerance
    if storey.ceilings:
        over = np.min([ceiling.height(xyz) - ceiling.tolerance for ceiling in storey.ceilings[-1:]], axis=0) > 0
        top = float(np.median(z[on_ceiling])) if on_ceiling.any() else top
    room = (top - bottom) if not storey.floor else float(np.percentile(height, 99)) if not storey.ceilings else (
        top - float(np.median(z[on_floor]))) if on_floor.any() else top - bottom  # fmt: skip
    body = np.flatnonzero(~(on_floor | on_ceiling | under_floor | over))
    layer = storey.floor.tolerance if storey.floor else 0.0
    runs = find_walls(xyz[body], height[body], xyz[on_floor], layer, room, spacing)
    near_wall = np.zeros(n, bool)
    for run in runs:
        near_wall |= run.contains(xyz)
    is_wall = np.zeros(n, bool)
    is_wall[body] = _in_walls(xyz[body], runs, spacing) | _pillars(
        xyz[body], height[body], xyz[on_floor], layer, runs, MODEL.reach * room, spacing
    )
    rest = body[~is_wall[body]]
    moved = rest[_trails(xyz[rest], height[rest], xyz[on_floor], layer, spacing)]
    rest = np.setdiff1d(rest, moved)
    treads = rest[_stairs(xyz[rest], spacing)]
    code[moved] = CODE["person"]
    code[is_wall] = CODE["wall"]
    code[treads] = CODE["stairs"]
    code[on_ceiling] = CODE["ceiling"]
    code[on_floor] = CODE["floor"]
    # a wall's lowest and highest points
    for levels in ([storey.floor] if storey.floor else [], storey.ceilings):
        for level in levels:
            away = np.abs(level.height(xyz))
            code[near_wall & (away < level.tolerance) & (away > 0.5 * level.tolerance)] = CODE["wall"]
    sure[code != CODE["furniture"]] = 220
    return code, sure, runs


def find_walls(xyz: F32, height: F64, floor: F32, layer: float, room: float, spacing: float) -> list[Run]:
    """Walls of a storey from points (N, 3) between floor and ceiling.

    Args:
        xyz: points.
        height: (N,) above the floor, metres.
        floor: (M, 3) points up to `layer` metres from the floor, those of walls included.
        layer: metres.
        room: height of the storey's rooms, metres.
        spacing: typical distance of neighbouring points, metres.
    """
    if not len(xyz):
        return []
    xy = xyz[:, :2].astype(np.float64)
    free = np.ones(len(xyz), bool)
    runs = []
    for run in find_runs(columns(xyz, spacing)):
        own = np.flatnonzero(run.contains(xy) & free)
        if not _is_wall(run, xyz[own], height[own], floor, layer, room):
            continue
        run = refined(run, xy)
        runs.append(run)
        free &= ~run.contains(xy, MODEL.wall_margin)
    return runs


def _in_walls(xyz: F32, runs: list[Run], spacing: float) -> Bools:
    """(N,) points in walls or in their noise, except where furniture stands in front and hides the wall.

    Furniture in front of a wall hides it where the points at the wall's face are nearer to the room than elsewhere.
    Behind a wall that has a room on one side only, window panes and reveals belong to it.
    """
    from scipy import ndimage

    margin, cell = MODEL.wall_margin, max(0.15, 2.5 * spacing)
    depth = MODEL.furniture_depth
    noise = wall_noise(runs)
    xy = xyz[:, :2].astype(np.float64)
    beyond = np.ones(len(xyz), bool)
    for run in runs:
        beyond &= ~replace(run, start=run.start - depth, end=run.end + depth).contains(xy, margin)
    result = np.zeros(len(xyz), bool)
    for run in runs:
        d, u = run.coordinates(xy)
        near = np.flatnonzero((np.abs(d) <= run.half + depth) & (u >= run.start - depth) & (u <= run.end + depth))
        rooms = [np.count_nonzero((s * d > run.half + depth) & (s * d < run.half + 4 * depth)
                 & (u > run.start) & (u < run.end)) for s in (-1.0, 1.0)]  # fmt: skip
        d, u = d[near], u[near]
        at = np.floor(np.column_stack([u, xyz[near, 2]]) / cell).astype(np.int64)
        at -= at.min(axis=0) if len(at) else 0
        shape = tuple(at.max(axis=0) + 1) if len(at) else (0, 0)
        of, count = at[:, 0] * shape[1] + at[:, 1], shape[0] * shape[1]
        own = (np.abs(d) <= run.half + margin) & (u >= run.start - depth / 2) & (u <= run.end + depth / 2)
        two = 2 * (run.half - noise) >= MODEL.two_sided
        for k, side in enumerate((-1.0, 1.0)):
            x = side * d
            if rooms[k] < MODEL.outside_share * rooms[1 - k]:
                own |= (x > 0) & (x <= run.half + MODEL.reveal) & (u >= run.start) & (u <= run.end)
                continue
            face = (x <= run.half + margin) & (x > (0.0 if two else -run.half - margin))
            points, front = (
                ndimage.uniform_filter(np.bincount(of[one], minlength=count).astype(float).reshape(shape), size)
                for one, size in ((face, 3), ((x > run.half + margin) & beyond[near], 5))
            )
            total = ndimage.uniform_filter(np.bincount(of[face], x[face], count).reshape(shape), 3)
            mean = total / np.maximum(points, 1e-9)
            clear = (points >= 3) & (front < 0.2 * MODEL.furniture_points)
            usual = float(np.median(mean[clear])) if clear.sum() >= 5 else np.inf
            hidden = ((front >= 0.3 * MODEL.furniture_points) & (mean > usual + MODEL.hidden_shift)).ravel()
            own &= ~(hidden[of] & (x > usual - MODEL.hidden_depth))
        result[near[own]] = True
    return result


def _is_wall(run: Run, xyz: F32, height: F64, floor: F32, layer: float, room: float) -> bool:
    """Whether a run reaches the top of its storey over enough of its length, or is long and half as high.

    Trails of people are long, too, but the floor was seen below them.
    """
    d, u = run.coordinates(xyz)
    bins = max(1, round(run.length / 0.25))
    k = np.clip(((u - run.start) / max(run.length, 1e-6) * bins).astype(np.int64), 0, bins - 1)
    top = np.full(bins, -np.inf)
    np.maximum.at(top, k, height)
    if float((top > MODEL.reach * room).mean()) >= MODEL.reach_share:
        return True
    long = run.length > MODEL.long_wall and float((top > 0.5 * room).mean()) > 0.6
    above = np.bincount(k[height > MODEL.person], minlength=bins)
    if not long or not len(floor) or float((above >= MODEL.person_points).mean()) >= MODEL.person_share:
        return long
    count = np.bincount(k, minlength=bins)
    solid = count > 0.3 * np.median(count[count > 0])
    tall = np.percentile(height, 90) - layer
    own = np.bincount(k[np.abs(d) < 0.5 * run.half], minlength=bins) * float(layer / max(tall, 0.1))
    return _floor_share(run, floor, own.astype(np.float64), solid) < MODEL.floor_share


def _floor_share(run: Run, floor: F32, own: F64, solid: Bools) -> float:
    """Share of a run's solid parts (B,) below whose middle as much floor was seen as beside it.

    Args:
        run: with B parts of equal length.
        floor: (M, 3) points of the floor.
        own: (B,) expected number of points of the run itself among them.
        solid: (B,) parts to count.
    """
    d, u = run.coordinates(floor)
    bins = len(solid)
    k = np.floor((u - run.start) / max(run.length, 1e-6) * bins).astype(np.int64)
    along = (k >= 0) & (k < bins)

    def count(low: float, high: float) -> F64:
        return np.bincount(k[along & (d > low) & (d < high)], minlength=bins).astype(np.float64)

    beside = np.maximum(count(-run.half - 0.6, -run.half - 0.1), count(run.half + 0.1, run.half + 0.6)) / 0.5
    usual = float(np.median(beside))
    below = (count(-0.5 * run.half, 0.5 * run.half) - own) / run.half
    return float((below > MODEL.floor_density * usual)[solid].mean()) if usual > 0 and solid.any() else 0.0


def _pillars(xyz: F32, height: F64, floor: F32, layer: float, runs: list[Run], reach: float, spacing: float) -> Bools:
    """(N,) points of compact groups of columns that are isolated and as high as walls.

    A lidar sees what is near only up to some height: narrow ones count if the walls around them were not seen higher.
    """
    from scipy import ndimage

    xy = xyz[:, :2].astype(np.float64)
    free, in_wall = height > 0.0, np.zeros(len(xyz), bool)
    for run in runs:
        own = run.contains(xy, 0.08)
        free &= ~own
        in_wall |= own
    rest = np.flatnonzero(free)
    result = np.zeros(len(xyz), bool)
    if not len(rest):
        return result
    cell = max(0.1, 1.5 * spacing)
    low = xyz[:, :2].min(axis=0)
    shape = np.floor((xyz[:, :2].max(axis=0) - low) / cell).astype(np.int64) + 1

    def cells(points: F32) -> I64:
        index = np.floor((points[:, :2] - low) / cell).astype(np.int64).clip(0, shape - 1)
        return np.asarray(index[:, 0] * shape[1] + index[:, 1])

    def tops(which: Bools | I64) -> F64:
        high = np.zeros(shape.prod())
        np.maximum.at(high, cells(xyz[which]), height[which])
        return high.reshape(shape)

    flat, high, wall_top = cells(xyz[rest]), tops(rest), tops(in_wall)
    layers = np.unique(flat * 64 + np.clip((height[rest] / 0.15).astype(np.int64), 0, 63)) // 64
    layers = np.bincount(layers, minlength=shape.prod()).reshape(shape)
    ground, body = (np.bincount(cells(part), minlength=shape.prod()).reshape(shape) for part in (floor, xyz))
    # objects on the floor have points at its height, too
    ground = ground - layer * body / np.maximum(high, max(2 * layer, 0.1))
    seen_floor = ground > MODEL.floor_density * (np.median(ground[ground > 0]) if (ground > 0).any() else np.inf)
    full = (layers >= 0.3 * MODEL.min_pillar / 0.15) & (high > 0.7 * MODEL.min_pillar)
    label, count = ndimage.label(full, np.ones((3, 3)))
    good = np.zeros(count + 1, bool)
    around = round(MODEL.pillar_walls / cell)
    for k, (rows, cols) in enumerate(ndimage.find_objects(label), start=1):
        own = label[rows, cols] == k
        top, wide = float(high[rows, cols][own].max()), max(own.shape) * cell
        near = wall_top[
            max(0, rows.start - around) : rows.stop + around, max(0, cols.start - around) : cols.stop + around
        ]
        seen = float(np.median(near[near > 0])) if (near > 0).any() else np.inf
        if top > reach:
            good[k] = own.sum() >= 3 and wide <= MODEL.max_pillar
        elif top > max(MODEL.min_pillar, MODEL.pillar_share * seen):
            inside = ndimage.binary_fill_holes(ndimage.binary_closing(np.pad(own, 3), np.ones((3, 3)), 3))[3:-3, 3:-3]
            core = ndimage.binary_erosion(inside, np.ones((3, 3)))
            clear = seen_floor[rows, cols][core if core.any() else inside].mean() < 0.5
            good[k] = own.sum() >= 4 and wide <= MODEL.narrow_pillar and clear
    grown = ndimage.binary_dilation(good[label], np.ones((3, 3)))
    result[rest[grown.ravel()[flat]]] = True
    return result


def _trails(xyz: F32, height: F64, floor: F32, layer: float, spacing: float) -> Bools:
    """(N,) points of people who walked through the map.

    They are as high as people, filled from the floor on, and the floor was seen below them at other times.

    Args:
        xyz: (N, 3) points of furniture.
        height: (N,) above the floor, metres.
        floor: (M, 3) points up to `layer` metres from the floor.
        layer: metres.
        spacing: typical distance of neighbouring points, metres.
    """
    from scipy import ndimage

    result = np.zeros(len(xyz), bool)
    if not len(xyz) or len(floor) < 50:
        return result
    cell = max(0.1, 1.5 * spacing)
    low = xyz[:, :2].min(axis=0)
    shape = np.floor((xyz[:, :2].max(axis=0) - low) / cell).astype(np.int64) + 1

    def cells(points: F32) -> I64:
        index = np.floor((points[:, :2] - low) / cell).astype(np.int64)
        inside = ((index >= 0) & (index < shape)).all(axis=1)
        return np.where(inside, index[:, 0] * shape[1] + index[:, 1], shape.prod())

    def count(flat: I64) -> F64:
        return np.bincount(flat, minlength=shape.prod() + 1)[:-1].reshape(shape).astype(np.float64)

    flat = cells(xyz)
    top = np.zeros(shape.prod())
    np.maximum.at(top, flat, height)
    top = top.reshape(shape)
    step = max(0.2, 3 * spacing)
    body = (height > MODEL.ankle) & (height < MODEL.chest)
    layers = count(np.unique(flat[body] * 64 + (height[body] / step).astype(np.int64)) // 64)
    filled = ndimage.maximum_filter(layers, 3) >= 0.7 * (MODEL.chest - MODEL.ankle) / step
    tall = (ndimage.maximum_filter(top, 3) > MODEL.chest) & (top > MODEL.ankle)
    ground = count(cells(floor)) - layer * count(flat) / np.maximum(top, 2 * layer)
    usual = float(np.median(ground[ground > 0])) if (ground > 0).any() else 0.0
    if usual < MODEL.floor_points:
        return result
    seen_floor = ground > MODEL.floor_density * usual
    label, number = ndimage.label(filled & tall, np.ones((3, 3)))
    good = np.zeros(number + 1, bool)
    for k, (rows, cols) in enumerate(ndimage.find_objects(label), start=1):
        own = label[rows, cols] == k
        inside = ndimage.binary_fill_holes(ndimage.binary_closing(np.pad(own, 3), np.ones((3, 3)), 2))[3:-3, 3:-3]
        core = ndimage.binary_erosion(inside, np.ones((3, 3)))
        inner = core if core.any() else inside
        high = float(np.quantile(top[rows, cols][own], 0.9))
        good[k] = (
            own.sum() >= 3
            and MODEL.chest < high < MODEL.person
            and seen_floor[rows, cols][inner].mean() > MODEL.trail_share
        )
    grown = ndimage.grey_dilation(np.where(good[label], label, 0), size=(3, 3))
    return np.asarray((good[label] | ((label == 0) & (grown > 0))).ravel()[flat])


def _stairs(xyz: F32, spacing: float) -> Bools:
    """(N,) points of flights of stairs: connected regions near a plane that slopes as stairs do."""
    from scipy import ndimage
    from scipy.spatial import cKDTree

    result = np.zeros(len(xyz), bool)
    if len(xyz) < 100 or np.ptp(xyz[:, 2]) < MODEL.stair_height:
        return result
    size = max(0.12, 2 * spacing)
    key = np.floor(xyz / size).astype(np.int64)
    _, first = np.unique(key, axis=0, return_index=True)
    thin = xyz[first].astype(np.float64)
    rng = np.random.default_rng(0)
    low, high = (np.tan(np.radians(v)) for v in MODEL.stair_slope_deg)
    for _ in range(6):
        if len(thin) < 60:
            break
        tree = cKDTree(thin)
        best, members = 0.0, None
        for _ in range(300):
            seed = thin[rng.integers(len(thin))]
            near = thin[tree.query_ball_point(seed, 1.2)]
            if len(near) < 30:
                continue
            a, b, c = near[rng.choice(len(near), 3, replace=False)]
            normal = np.cross(b - a, c - a)
            if abs(normal[2]) < 1e-6 or not low < np.hypot(*normal[:2]) / abs(normal[2]) < high:
                continue
            normal /= np.linalg.norm(normal)
            inside = np.abs((near - a) @ normal) < MODEL.stair_tolerance
            if inside.mean() > 0.5 and inside.sum() > best:
                best, members = float(inside.sum()), np.array([*normal, a @ normal])
        if members is None:
            break
        on = np.abs(thin @ members[:3] - members[3]) < MODEL.stair_tolerance
        plan = np.floor((thin[on, :2] - thin[on, :2].min(axis=0)) / (1.5 * size)).astype(np.int64)
        grid = np.zeros(plan.max(axis=0) + 1, bool)
        grid[plan[:, 0], plan[:, 1]] = True
        label, _ = ndimage.label(grid, np.ones((3, 3)))
        part = label[plan[:, 0], plan[:, 1]]
        largest = int(np.bincount(part).argmax())
        chosen = np.flatnonzero(on)[part == largest]
        flight = thin[chosen]
        if np.ptp(flight[:, 2]) >= MODEL.stair_height and (label == largest).sum() * (1.5 * size) ** 2 > 1.0:
            slab = np.abs(xyz @ members[:3].astype(np.float32) - np.float32(members[3])) < MODEL.stair_tolerance
            near = np.flatnonzero(slab)[cKDTree(flight).query(xyz[slab], distance_upper_bound=2 * size)[0] < np.inf]
            # hardly anything stands on stairs or below them, where furniture has its sides
            over = (thin @ members[:3] - members[3]) * np.sign(members[2])
            plan_tree = cKDTree(flight[:, :2])
            beside = np.isfinite(plan_tree.query(thin[:, :2], distance_upper_bound=size)[0])
            crowd = np.count_nonzero(beside & (over > 1.5 * MODEL.stair_tolerance) & (over < 1.0))
            below = np.count_nonzero(beside & (over < -1.5 * MODEL.stair_tolerance))
            if max(crowd, below) < MODEL.stair_crowd * len(flight):
                result[near] = True
        thin = np.delete(thin, chosen, axis=0)
    return result
