"""Storeys of an indoor map, from the levels at which much of the plan has points: floors and ceilings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from scan2sim.pipeline.core.types import F32, F64


@dataclass(frozen=True)
class StoreyModel:
    """Limits; lengths in metres."""

    plan_cell: float = 0.2
    """Cell in plan view in which a level has points or not."""
    bin: float = 0.05
    min_area: float = 3.0
    """Smallest area of a level, m2."""
    min_share: float = 0.03
    """Smallest area of a level, of the whole plan."""
    slab: tuple[float, float] = (0.08, 0.9)
    """Thickness between a ceiling and the floor above it."""
    furnished_share: float = 0.1
    """Share of a floor's plan with things on it, from which it is no ceiling."""
    min_room: float = 1.9
    """Smallest height of a room."""
    floor_height: float = 0.4
    """Height above the lowest points up to which the lowest level is a floor, not tables."""
    floor_share: float = 0.25
    """Share of the plan from which it is one in any case: reflections may lie below."""
    max_tilt: float = 0.02
    """Slope of a level up to which it is a tilt of the map."""
    tolerance: tuple[float, float] = (0.04, 0.15)
    """Limits of the distance of a level's points from it."""


MODEL = StoreyModel()


class Level(NamedTuple):
    """A floor or ceiling z = a x + b y + c."""

    plane: F64
    tolerance: float
    area: float

    def height(self, xyz: F32) -> F64:
        """(N,) signed distance above it."""
        return xyz[:, 2].astype(np.float64) - xyz[:, :2].astype(np.float64) @ self.plane[:2] - self.plane[2]

    def at(self, xyz: F32) -> float:
        """Height of the level at a position (1, 3 or 2)."""
        return float(xyz[0, :2] @ self.plane[:2] + self.plane[2])


class Storey(NamedTuple):
    """A storey: heights of its lower and upper end, its floor and its ceilings (None, empty: not seen)."""

    low: float
    high: float
    floor: Level | None
    ceilings: list[Level]


MIN_POINTS = 20
"""Fewer points have no levels."""


def find_storeys(xyz: F32, spacing: float) -> list[Storey]:
    """Storeys from the lowest to the highest; together they contain all points."""
    if len(xyz) < MIN_POINTS:
        return [Storey(-np.inf, np.inf, None, [])]
    levels = _levels_of_tilted(xyz, spacing)
    z = xyz[:, 2].astype(np.float64)
    low, high = (float(v) for v in np.percentile(z, (0.5, 99.5)))
    centre = [float(np.median(z[np.abs(level.height(xyz)) < level.tolerance])) for level in levels]
    kept = _distinct(levels, centre)
    levels, centre = [levels[i] for i in kept], [centre[i] for i in kept]
    floors: list[int] = []
    ceilings: dict[int, list[int]] = {}
    for i, at in enumerate(centre):
        above, below = (np.count_nonzero(side) for side in (z > at + 0.3, z < at - 0.3))
        if not floors and not ceilings:
            is_floor = above > below and (
                at - low < MODEL.floor_height
                or (at - low < MODEL.min_room and levels[i].area > MODEL.floor_share * _plan_area(xyz, spacing))
            )
        else:
            under = [centre[k] for k in ceilings.get(len(floors) - 1, [])]
            start = centre[floors[-1]] if floors else low
            if under and MODEL.slab[0] <= at - max(under) <= MODEL.slab[1] and high - at > 0.5:
                is_floor = True
            elif at - start < MODEL.min_room:
                continue  # tables and other furniture
            elif not under and _is_upper_floor(xyz, levels[i], centre[i + 1 :], at):
                is_floor = True
            else:
                is_floor = False
        if is_floor:
            floors.append(i)
        elif at - (centre[floors[-1]] if floors else low) >= min(MODEL.min_room, 0.6 * (high - low)):
            ceilings.setdefault(len(floors) - 1, []).append(i)
    storeys: list[Storey] = []
    numbers = range(-1 if -1 in ceilings or not floors else 0, len(floors))
    for k in numbers:
        floor = levels[floors[k]] if k >= 0 else None
        start = -np.inf if k == numbers[0] else centre[floors[k]]
        if k != numbers[0]:
            under = [centre[j] for j in ceilings.get(k - 1, [])]
            start = (max(under) + start) / 2 if under else start - 0.1
            storeys[-1] = storeys[-1]._replace(high=start)
        storeys.append(Storey(start, np.inf, floor, [levels[j] for j in ceilings.get(k, [])]))
    return storeys


def _is_upper_floor(xyz: F32, level: Level, higher: list[float], at: float) -> bool:
    """Whether a level without a ceiling below it is a floor: things stand on it, and no other floor is above it."""
    if any(MODEL.slab[0] <= other - at <= MODEL.slab[1] for other in higher):
        return False
    height = level.height(xyz)
    own, on_top = (
        np.unique(np.floor(xyz[part, :2] / (2 * MODEL.plan_cell)).astype(np.int64), axis=0)
        for part in (np.abs(height) < level.tolerance, (height > 0.3) & (height < MODEL.min_room))
    )
    both = len(own) + len(on_top) - len(np.unique(np.concatenate([own, on_top]), axis=0))
    return both > MODEL.furnished_share * len(own)


def _distinct(levels: list[Level], centre: list[float]) -> list[int]:
    """Indices of the levels without those that are next to a larger one."""
    return [
        i for i, at in enumerate(centre)
        if not any(0 < abs(other - at) < MODEL.slab[0] and levels[k].area > levels[i].area
                   for k, other in enumerate(centre))
    ]  # fmt: skip


def _plan_area(xyz: F32, spacing: float) -> float:
    """Area in plan view of the cells with points, m2."""
    cell = max(MODEL.plan_cell, 2 * spacing)
    return len(np.unique(np.floor(xyz[:, :2] / cell), axis=0)) * cell**2


def _levels_of_tilted(xyz: F32, spacing: float) -> list[Level]:
    """Levels of a map, of which a few tenths of a degree of tilt may remain: that of its largest level."""
    levels = _levels(xyz, spacing)
    if not levels:
        return levels
    slope = max(levels, key=lambda level: level.area).plane[:2]
    rise = float(np.abs(slope) @ np.ptp(xyz[:, :2], axis=0))
    if rise < MODEL.bin or float(np.linalg.norm(slope)) > MODEL.max_tilt:
        return levels
    sheared = xyz.astype(np.float64)
    sheared[:, 2] -= sheared[:, :2] @ slope
    tilt = np.array([*slope, 0.0])
    return [level._replace(plane=level.plane + tilt) for level in _levels(sheared.astype(np.float32), spacing)]


def _levels(xyz: F32, spacing: float) -> list[Level]:
    """Levels at which much of the plan has points, from the lowest to the highest."""
    from scipy import ndimage

    cell, size = max(MODEL.plan_cell, 2 * spacing), max(MODEL.bin, 0.7 * spacing)
    points = xyz.astype(np.float64)
    low, high = np.percentile(points[:, 2], (0.2, 99.8))
    inside = np.flatnonzero((points[:, 2] > low - 0.5) & (points[:, 2] < high + 0.5))
    plan = np.floor((points[inside, :2] - points[inside, :2].min(axis=0)) / cell).astype(np.int64)
    _, column = np.unique(plan[:, 0] * (plan[:, 1].max() + 1) + plan[:, 1], return_inverse=True)
    layer = np.floor((points[inside, 2] - low + 0.5) / size).astype(np.int64)
    deep = int(layer.max()) + 1
    pair = np.unique(column * deep + layer)
    of, at = pair // deep, pair % deep
    # a wall fills columns, and its seen part ends somewhere: layers above and below a surface are empty
    around = round(0.35 / size)
    filled = np.zeros((int(column.max()) + 1, deep + 2 * around), bool)
    filled[of, at + around] = True
    total = np.cumsum(np.pad(filled, ((0, 0), (1, 0))), axis=1)
    clear = max(2, round(0.1 / size))
    above = total[of, at + 2 * around + 1] - total[of, at + around + clear]
    below = total[of, at + around - clear + 1] - total[of, at]
    thin = np.maximum(above, below) <= 0.3 * around
    count = np.bincount(at[thin], minlength=deep).astype(np.float64)
    area = np.convolve(count, np.ones(3), "same") * cell**2
    background = np.array([np.median(area[max(0, i - 12) : i + 13]) for i in range(deep)])
    least = max(MODEL.min_area, MODEL.min_share * len(filled) * cell**2)
    levels: list[tuple[float, Level]] = []
    left = np.where(area >= ndimage.maximum_filter1d(area, 3), area - background, 0.0)
    while len(levels) < 40:
        i = int(left.argmax())
        if left[i] < least or left[i] < 1.5 * background[i]:
            break
        z = low - 0.5 + (i + 0.5) * size
        level = _fit_level(points[inside], z, 2 * size, area[i])
        levels.append((z, level))
        left[max(0, i - round(0.15 / size)) : i + round(0.15 / size) + 1] = 0
    return [level for _, level in sorted(levels, key=lambda one: one[0])]


def _fit_level(points: F64, z: float, band: float, area: float) -> Level:
    """Plane through the points near height z, by iteratively reweighted least squares; slopes up to 2 degrees."""
    near = points[np.abs(points[:, 2] - z) < 3 * band]
    near = near[:: max(1, len(near) // 50_000)]
    middle = near[:, :2].mean(axis=0)
    A = np.column_stack([near[:, :2] - middle, np.ones(len(near))])
    plane = np.array([0.0, 0.0, z])
    scale = band
    for _ in range(6):
        r = near[:, 2] - A @ plane
        w = np.maximum(0.0, 1 - (r / scale) ** 2) ** 2
        if (w > 0).sum() < 10:
            break
        normal = (A * w[:, None]).T @ A + np.diag([1e-3 * w.sum(), 1e-3 * w.sum(), 0])
        plane = np.linalg.solve(normal, (A * w[:, None]).T @ near[:, 2])
        plane[:2] = np.clip(plane[:2], -0.035, 0.035)
        r = np.abs(near[:, 2] - A @ plane)
        scale = float(np.clip(4.5 * np.median(r[r < band]) if (r < band).any() else band, 0.04, band))
    tolerance = float(np.clip(scale, *MODEL.tolerance))
    return Level(np.array([plane[0], plane[1], plane[2] - plane[:2] @ middle]), tolerance, area)
