"""List of doors, windows, passages and stairs of rooms: positions, sizes and axes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from scan2sim.pipeline.buildings.wall_slabs import Wall
from scan2sim.pipeline.core.types import F32, F64

MAX_DOOR_WIDTH_M = 2.2
"""Wider openings down to the floor are passages or fronts of glass."""
MAX_THRESHOLD_M = 0.3
"""Height of the lower edge of an opening above the floor from which it is a window."""
MIN_STAIR_POINTS = 30
STAIR_GAP_M = 0.3


class Opening(NamedTuple):
    """An opening, or a flight of stairs.

    Attributes:
        kind: "door", "passage", "window" or "stairs".
        storey: index of its storey, from the lowest.
        position: (3,) middle of its lower edge, in the middle of the wall; the foot of stairs; metres.
        width, height: metres; of stairs, height is their rise.
        axis: (2,) horizontal unit vector through the opening, either way; of stairs upwards.
        length: thickness of the wall, or horizontal length of stairs, metres.
    """

    kind: str
    storey: int
    position: F64
    width: float
    height: float
    axis: F64
    length: float


def openings_of(walls: Sequence[Wall], storey: int) -> Iterator[Opening]:
    """Openings of the walls of a storey."""
    for wall in walls:
        run = wall.run
        for u0, u1, z0, z1 in wall.openings:
            start, end = max(u0, run.start), min(u1, run.end)
            low, high = max(z0, wall.low), min(z1, wall.high)
            if start >= end or low >= high:
                continue
            middle = run.offset * run.normal + (start + end) / 2 * run.along
            kind = "window" if low > wall.low + MAX_THRESHOLD_M else "door"
            kind = "passage" if kind == "door" and end - start > MAX_DOOR_WIDTH_M else kind
            yield Opening(kind, storey, np.array([*middle, low]), end - start, high - low, run.normal, 2 * run.half)


def stairs_of(xyz: F32, storey: int, spacing: float) -> Iterator[Opening]:
    """Flights of stairs from points (N, 3) of the class stairs."""
    from scipy import ndimage

    if len(xyz) < MIN_STAIR_POINTS:
        return
    cell = max(STAIR_GAP_M / 2, 2 * spacing)
    at = np.floor((xyz[:, :2] - xyz[:, :2].min(axis=0)) / cell).astype(np.int64)
    plan = np.zeros(at.max(axis=0) + 1, bool)
    plan[tuple(at.T)] = True
    label, count = ndimage.label(plan, np.ones((3, 3)))
    flight = label[tuple(at.T)]
    for k in range(1, count + 1):
        own = xyz[flight == k].astype(np.float64)
        if len(own) < MIN_STAIR_POINTS:
            continue
        middle = own.mean(axis=0)
        slope = np.linalg.lstsq(own[:, :2] - middle[:2], own[:, 2] - middle[2], rcond=None)[0]
        steep = float(np.linalg.norm(slope))
        if steep < 1e-3:
            continue
        up = slope / steep
        along, across = (own[:, :2] - middle[:2]) @ up, (own[:, :2] - middle[:2]) @ np.array([-up[1], up[0]])
        (start, end), (left, right) = (np.percentile(x, (2, 98)) for x in (along, across))
        low, high = np.percentile(own[:, 2], (2, 98))
        foot = middle[:2] + start * up + (left + right) / 2 * np.array([-up[1], up[0]])
        yield Opening("stairs", storey, np.array([*foot, low]), right - left, high - low, up, end - start)
