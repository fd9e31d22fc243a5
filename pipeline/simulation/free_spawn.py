"""Spawn pose of a robot in the free space of an occupancy map."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.simulation.occupancy import Storey
from scan2sim.pipeline.simulation.robot import Start

CLEARANCE_M = 0.6
"""Wanted distance from obstacles: the circumscribed circle of the robot (`pipeline.simulation.robot`) is .53 m."""
DROP_HEIGHT_M = 0.02
"""Initial height above the floor."""
HEADINGS = 16
PLANE_RADIUS_M = 0.5
"""Radius of the floor to which the pose is levelled."""


def spawn_pose(storey: Storey, near: F64 | None) -> tuple[Start, float]:
    """Pose on the floor, facing the longest free way, and its distance from the nearest cell that isn't free (m).

    Args:
        storey: the map.
        near: (3,) where the robot started, if known: the nearest position with enough clearance is chosen, otherwise
            the one with the most.
    """
    clearance = storey.clearance()
    most = float(clearance.max())
    if near is None:
        chosen = int(clearance.argmax())
    else:
        enough = np.flatnonzero(clearance.ravel() >= min(CLEARANCE_M, most))
        away = np.linalg.norm(storey.grid.centres(enough) - near[:2], axis=1)
        chosen = int(enough[away.argmin()])
    x, y = storey.grid.centres(np.array([chosen]))[0].tolist()
    heading = _longest_way(storey, np.array([x, y]))
    slope, height = _plane(storey, np.array([x, y]))
    c, s = np.cos(heading), np.sin(heading)
    ahead, left = slope @ (c, s), slope @ (-s, c)
    angles = float(np.arctan(left)), float(-np.arctan(ahead)), heading
    return Start((x, y, height + DROP_HEIGHT_M), angles, "floor"), float(clearance.ravel()[chosen])


def _longest_way(storey: Storey, xy: F64) -> float:
    """Heading, radians, in which the most free cells follow each other."""
    grid = storey.grid
    far = np.arange(0.0, np.hypot(*grid.shape) * grid.cell, grid.cell)
    best, heading = -1, 0.0
    for angle in np.arange(HEADINGS) * 2 * np.pi / HEADINGS:
        way = xy + far[:, None] * (np.cos(angle), np.sin(angle))
        cell = np.floor((way - np.asarray(grid.origin)) / grid.cell).astype(int)
        inside = ((cell >= 0) & (cell < grid.shape[::-1])).all(axis=1)
        open_way = inside.copy()
        open_way[inside] = storey.free[cell[inside, 1], cell[inside, 0]]
        length = len(far) if open_way.all() else int(open_way.argmin())
        if length > best:
            best, heading = length, float(np.arctan2(np.sin(angle), np.cos(angle)))
    return heading


def _plane(storey: Storey, xy: F64) -> tuple[F64, float]:
    """Slope (2,) of the floor around a position, and its height there."""
    index = np.flatnonzero(storey.free)
    offset = storey.grid.centres(index) - xy
    near = np.linalg.norm(offset, axis=1) <= PLANE_RADIUS_M
    rows = np.column_stack([offset[near], np.ones(int(near.sum()))])
    heights = storey.floor.ravel()[index[near]].astype(np.float64)
    if len(rows) < 4:
        return np.zeros(2), float(heights.max())
    (a, b, height), *_ = np.linalg.lstsq(rows, heights, rcond=None)
    return np.array([a, b]), float(height)
