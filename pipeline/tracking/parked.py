"""Parked vehicles: one box for all sweeps, whose unseen sides are completed by a typical size."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.tracking.extents import (
    FACE_SIGMA_M,
    FRONTAL_MARGIN_M,
    OUTLIERS_PERCENT,
    RESOLVED_M,
    axes,
    completed,
    spacing,
)
from scan2sim.pipeline.tracking.sizes import CAR_HEIGHT_MAX_M, LARGEST, TYPICAL, Size
from scan2sim.pipeline.tracking.tracks import Category

BODY_M = (0.25, 1.3)
"""Heights above ground of the sides of a body; roofs and mirrors are above."""
YAW_RANGE_DEG, YAW_STEP_DEG = 8.0, 0.5
"""Yaws about the detected one that are tried."""
MAX_POINTS = 3000
"""Points that a box is fitted to."""
SMALL_SHARE = 0.72
"""Share of the typical size below which a vehicle was hidden in part in all sweeps."""
END_SHARE = 0.22
"""Share of the length at each end whose heights distinguish the bonnet from the rear."""
BONNET_M = 0.12
"""Difference of height from which the lower end is the front."""
BODY_HEIGHT_M, BODY_BIN_M, BODY_SHARE = 0.7, 0.3, 0.6
"""Height that the body of a vehicle has all along its length (bonnets are higher), bins of its length, and the smallest
share of those with points that must reach it: hedges with a post or a car beyond don't."""
FIT_RADIUS_M = 0.05
"""Distance of a point from a side within which it is on it."""


@dataclass(frozen=True)
class Box:
    """A box in plan.

    Attributes:
        category: its class.
        centre: (2,) local metres.
        yaw: radians.
        size: length, width, height in metres.
        sigma: of the position (m) and the yaw (rad).
    """

    category: Category
    centre: F64
    yaw: float
    size: tuple[float, float, float]
    sigma: tuple[float, float]


def fit(xyz: F64, height: F64, yaw: float, scanner: F64, turns_right: bool = True) -> Box:
    """The box of a parked vehicle.

    Args:
        xyz: (N, 3) its returns in all sweeps, local metres.
        height: (N,) metres above ground.
        yaw: direction of its length, about; front and back may be swapped.
        scanner: (S, 2) positions of the scanner from which it was seen, in order of time.
        turns_right: whether traffic keeps to the right: decides on front and back where the shape doesn't.
    """
    top = float(np.percentile(height, 98))
    body = (height > BODY_M[0]) & (height < BODY_M[1])
    xy = xyz[body, :2] if body.sum() > 20 else xyz[:, :2]
    yaw, sigma_yaw = best_yaw(xy[:: max(1, len(xy) // MAX_POINTS)], yaw)
    # of a vehicle of which one end was seen, the width is the longer side of what was seen
    sides = [_sides(xy, top, yaw + turn, scanner) for turn in (0.0, np.pi / 2)]
    found = max(sides, key=lambda one: one.evidence)
    typical, largest = TYPICAL[found.category], LARGEST[found.category]
    yaw = _forward(xyz, height, found.centre, found.yaw, found.size[0], scanner, turns_right)
    size = float(found.size[0]), float(found.size[1]), min(max(top, SMALL_SHARE * typical.height), largest.height)
    return Box(found.category, found.centre, yaw, size, (float(np.hypot(*found.sigma) / np.sqrt(2)), sigma_yaw))


class Sides(NamedTuple):
    """A box in plan by one of two directions: its fields are those of `Box`, and the evidence for it."""

    category: Category
    centre: F64
    yaw: float
    size: F64
    sigma: F64
    evidence: float


def _sides(xy: F64, top: float, yaw: float, scanner: F64) -> Sides:
    """The box of points (N, 2) with a roof at `top` metres above ground whose length has the direction `yaw`."""
    category: Category = "car"
    R, reference = axes(yaw), np.median(xy, axis=0)
    local, seen_from = (xy - reference) @ R, (scanner - reference) @ R
    low, high = np.percentile(local, (OUTLIERS_PERCENT, 100 - OUTLIERS_PERCENT), axis=0)
    if top > LARGEST["van"].height or high[0] - low[0] > LARGEST["van"].length:
        category = "truck"
    elif top > CAR_HEIGHT_MAX_M or high[0] - low[0] > LARGEST["car"].length + 0.2:
        category = "van"
    typical, largest = TYPICAL[category], LARGEST[category]
    middle, size, sigma, evidence = np.zeros(2), np.zeros(2), np.zeros(2), 1.0
    for axis in (0, 1):
        middle[axis], size[axis], sigma[axis], density = _complete(low, high, seen_from, axis, typical, largest)
        evidence *= density
    return Sides(category, reference + R @ middle, yaw, size, sigma, evidence)


def has_body(xyz: F64, height: F64, centre: F64, yaw: float) -> bool:
    """Whether points (N, 3) reach the height of a vehicle's body along its length."""
    u = (xyz[:, :2] - centre) @ axes(yaw)[:, 0]
    place = np.floor((u - u.min()) / BODY_BIN_M).astype(np.int64)
    tops = np.zeros(place.max() + 1)
    np.maximum.at(tops, place, height)
    return bool((tops[tops > 0] > BODY_HEIGHT_M).mean() > BODY_SHARE)


def best_yaw(xy: F64, yaw: float) -> tuple[float, float]:
    """Yaw near `yaw` at which the sides of the points' rectangle hold most points, and its standard deviation."""
    tried = yaw + np.radians(np.arange(-YAW_RANGE_DEG, YAW_RANGE_DEG + 1e-6, YAW_STEP_DEG))
    scores = []
    for turn in tried:
        local = xy @ axes(float(turn))
        low, high = np.percentile(local, (1, 99), axis=0)
        gap = np.minimum(np.abs(local - low), np.abs(high - local)).min(axis=1)
        scores.append(float((1 / np.maximum(gap, FIT_RADIUS_M)).mean()))
    best = int(np.argmax(scores))
    good = tried[np.array(scores) > 0.97 * scores[best]]
    return float(np.mean(good)), float(max(np.ptp(good) / 2, np.radians(YAW_STEP_DEG)))


def _complete(
    low: F64, high: F64, scanner: F64, axis: int, typical: Size, largest: Size
) -> tuple[float, float, float, float]:
    """Middle, size, standard deviation of the middle, and evidence (1/m), along an axis of the box."""
    extent = float(high[axis] - low[axis])
    offset = scanner - (low + high) / 2
    gaps = spacing(offset, np.abs(offset[:, 1 - axis]) - (high[1 - axis] - low[1 - axis]) / 2)
    best = np.sort(gaps)[: max(1, len(scanner) // 4)]
    outside = low[axis] - scanner[:, axis], scanner[:, axis] - high[axis]
    sees_low, sees_high = (_sees(offset, beyond, RESOLVED_M) for beyond in outside)
    if not (sees_low or sees_high):
        sees_low, sees_high = (_sees(offset, beyond, np.inf) for beyond in outside)
    size, spread, density = completed(
        extent, float(best.mean() / np.sqrt(len(best))), axis, typical[axis], largest[axis]
    )
    if sees_low and sees_high and extent > SMALL_SHARE * typical[axis]:
        size, spread = min(extent, largest[axis]), 0.0
    if sees_low and not sees_high:
        return float(low[axis]) + size / 2, size, FACE_SIGMA_M + spread / 2, density
    if sees_high and not sees_low:
        return float(high[axis]) - size / 2, size, FACE_SIGMA_M + spread / 2, density
    return float(low[axis] + high[axis]) / 2, size, FACE_SIGMA_M + max(size - extent, 0.0) / 2, density


def _sees(offset: F64, beyond: F64, finest: float) -> bool:
    """Whether a face was seen with a spacing of points below `finest`, from positions `beyond` (S,) metres outside."""
    return bool(((beyond > FRONTAL_MARGIN_M) & (spacing(offset, beyond) < finest)).any())


def _forward(xyz: F64, height: F64, centre: F64, yaw: float, length: float, scanner: F64, right: bool) -> float:
    """Yaw towards the bonnet, the lower end; if both are as high, that of the traffic on its side of the path."""
    u = (xyz[:, :2] - centre) @ axes(yaw)[:, 0]
    ends = [height[side * u > (0.5 - END_SHARE) * length] for side in (1, -1)]
    if min(len(end) for end in ends) > 20:
        tops = [float(np.percentile(end, 95)) for end in ends]
        if abs(tops[0] - tops[1]) > BONNET_M:
            return yaw if tops[0] < tops[1] else yaw + np.pi
    nearest = int(np.argmin(np.hypot(*(scanner - centre).T)))
    step = scanner[min(nearest + 1, len(scanner) - 1)] - scanner[max(nearest - 1, 0)]
    offset = centre - scanner[nearest]
    is_right = step[0] * offset[1] - step[1] * offset[0] < 0
    travel = step if is_right == right else -step
    return yaw if float(travel @ axes(yaw)[:, 0]) >= 0 else yaw + np.pi
