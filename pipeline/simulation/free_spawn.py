"""Spawn pose of the supplied robot in the free space of an occupancy map."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from scan2sim.pipeline.core.types import F64, Bools
from scan2sim.pipeline.simulation.occupancy import Storey
from scan2sim.pipeline.simulation.robot import ROBOT, Start

CLEARANCE_M = 0.6
"""Wanted distance from obstacles."""
LOW, HIGH = (np.array(corner[:2]) for corner in ROBOT.extent)
TURNING_RADIUS_M = float(np.hypot(*np.maximum(-LOW, HIGH)))
"""Radius of the circle around the robot's frame that it needs to turn on the spot."""
DROP_HEIGHT_M = 0.02
"""Initial height above the floor."""
HEADINGS_RAD = np.arange(16) * 2 * np.pi / 16
PLANE_RADIUS_M = 0.5
"""Radius of the floor to which the pose is levelled."""


class Spawn(NamedTuple):
    """A spawn pose.

    Attributes:
        start: the pose.
        clearance: distance from the nearest cell that isn't free, metres.
        fits: whether the robot's footprint is on free cells there.
        turns: whether it can also turn on the spot.
    """

    start: Start
    clearance: float
    fits: bool
    turns: bool


def spawn_pose(storey: Storey, near: F64 | None) -> Spawn:
    """Pose on the floor, facing the longest free way.

    Of the positions with enough clearance, or else of those at which the robot's footprint fits, or else of those with
    the most clearance.

    Args:
        storey: the map.
        near: (3,) where the robot started, if known: the nearest such position is chosen, otherwise the one with the
            most clearance.
    """
    clearance = storey.clearance()
    turning = TURNING_RADIUS_M + storey.grid.cell
    fitting = np.repeat((clearance >= max(CLEARANCE_M, turning))[None], len(HEADINGS_RAD), axis=0)
    if not fitting.any():
        fitting = np.stack([_fits(storey, heading) for heading in HEADINGS_RAD])
    fits = bool(fitting.any())
    if not fits:
        fitting[:] = clearance >= clearance.max()
    candidates = np.flatnonzero(fitting.any(axis=0))
    worth = clearance.ravel()[candidates]
    if near is not None:
        worth = -np.linalg.norm(storey.grid.centres(candidates) - near[:2], axis=1)
    chosen = candidates[[worth.argmax()]]
    own = float(clearance.ravel()[chosen[0]])
    (xy,) = storey.grid.centres(chosen)
    heading = _longest_way(storey, xy, HEADINGS_RAD[fitting.reshape(len(HEADINGS_RAD), -1)[:, chosen[0]]])
    slope, height = _plane(storey, xy)
    c, s = np.cos(heading), np.sin(heading)
    ahead, left = slope @ (c, s), slope @ (-s, c)
    angles = float(np.arctan(left)), float(-np.arctan(ahead)), heading
    start = Start((float(xy[0]), float(xy[1]), height + DROP_HEIGHT_M), angles, "floor")
    return Spawn(start, own, fits, own >= turning)


def _fits(storey: Storey, heading: float) -> Bools:
    """(Y, X) whether all cells below the robot's footprint are free if it stands at a cell's centre."""
    from scipy.ndimage import binary_erosion

    cell = storey.grid.cell
    count = int(np.ceil(TURNING_RADIUS_M / cell)) + 1
    steps = np.arange(-count, count + 1) * cell
    x, y = np.meshgrid(steps, steps)
    c, s = np.cos(heading), np.sin(heading)
    own, margin = np.stack([c * x + s * y, c * y - s * x], axis=-1), cell / 2**0.5
    footprint = ((own >= LOW - margin) & (own <= HIGH + margin)).all(axis=-1)
    return np.asarray(binary_erosion(storey.free, footprint))


def _longest_way(storey: Storey, xy: F64, headings: F64) -> float:
    """That of the headings (N,), radians, in which the most free cells follow each other; from -pi to pi."""
    grid = storey.grid
    far = np.arange(0.0, np.hypot(*grid.shape) * grid.cell, grid.cell)
    best, heading = -1, 0.0
    for angle in headings:
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
