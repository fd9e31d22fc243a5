"""Facade completion: extent of walls above the scanner's field of view, and closing of gaps in walls.

A wall is a vertical plane of the cloud, divided into cells. A column of cells may be extended if its scanned part ends
at the scanner's highest rays; a gap may be closed if no ray passed through it. The top of the wall is a curve over all
columns, found by dynamic programming from the evidence of each cell and a smoothness term. Import lazily: loads numba.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from numba import njit

from scan2sim.pipeline.core.types import F32, F64, I32, I64, Bools
from scan2sim.pipeline.geometry.planes import Planes

WALL_MAX_NORMAL_Z = float(np.sin(np.radians(10.0)))
"""Largest |nz| of a wall's plane."""


@dataclass(frozen=True)
class CompletionLimits:
    """Parameters of facade completion."""

    max_opening_m: float = 2.0  # width of windows and doors
    top_tolerance_cells: int = 3  # distance below the highest rays at which the scanned part counts as limited by them
    top_tolerance_rad: float = 0.015  # the same as an angle: two scan lines
    smoothing_m: float = 1.0  # length along a wall of the majority vote on whether the top was reached
    azimuth_bins: int = 72  # for the elevation of the highest rays
    min_bin_points: int = 50
    min_range_m: float = 3.0  # nearer returns are not used for the highest rays
    elevation_tolerance_rad: float = 0.005  # bins lower than the fitted cone by more than this saw no high objects
    max_open_fraction: float = 0.25  # walls with more cells that rays passed through are fences or gates
    min_behind_m: float = 0.3  # a ray that ends this far behind a wall passed through it
    edge_reward: float = 2.0  # of an image edge at the top of the wall, relative to a certain wall cell
    step_cost: float = 0.6  # per cell of height difference between neighbouring columns
    max_step_cost: float = 10.0


LIMITS = CompletionLimits()


@dataclass(frozen=True)
class Wall:
    """The plane of a wall, divided into square cells, rows upwards.

    Attributes:
        plane: index of the plane.
        corner: (3,) centre of cell (0, 0), local metres.
        along, up, normal: (3,) unit vectors; `along` is horizontal.
        cell: cell size, metres.
        known: (R, C) bool, scanned cells.
    """

    plane: int
    corner: F64
    along: F64
    up: F64
    normal: F64
    cell: float
    known: Bools

    def part(self, low: int, high: int) -> Wall:
        """The part of the wall with rows `low` to `high` - 1."""
        return replace(self, corner=self.places(low, 0), known=self.known[low:high])

    @cached_property
    def tops(self) -> I32:
        """Highest scanned row (C,) of each column; interpolated for columns without scanned cells."""
        rows, columns = self.known.shape
        has = np.flatnonzero(self.known.any(axis=0))
        if not len(has):
            return np.zeros(columns, np.int32)
        top = rows - 1 - np.argmax(self.known[::-1, has], axis=0)
        return np.rint(np.interp(np.arange(columns), has, top)).astype(np.int32)

    @cached_property
    def ends(self) -> I32:
        """`tops` (C,) with dips narrower than `max_opening_m` (above windows) closed."""
        width = 2 * round(LIMITS.max_opening_m / self.cell / 2) + 1
        whole = cv2.morphologyEx(self.tops[None].astype(np.int16), cv2.MORPH_CLOSE, np.ones((1, width), np.uint8))
        return whole[0].astype(np.int32)

    def places(self, row: npt.ArrayLike, column: npt.ArrayLike) -> F64:
        """Positions (..., 3) in local metres of rows and columns, which may be fractional."""
        r, c = np.asarray(row, np.float64)[..., None], np.asarray(column, np.float64)[..., None]
        return self.corner + self.cell * (r * self.up + c * self.along)

    def column_of(self, xyz: npt.ArrayLike) -> I32:
        """Columns (N,) of points (N, 3)."""
        at = np.rint((np.asarray(xyz, np.float64) - self.corner) @ self.along / self.cell)
        return np.clip(at, 0, self.known.shape[1] - 1).astype(np.int32)


def walls(xyz: F32, which: I32, planes: Planes, cell: float, rise: float) -> Iterator[Wall]:
    """Walls of a thinned cloud: its vertical planes, with `rise` metres of empty rows above the scanned part.

    Args:
        xyz: (N, 3) local metres.
        which: (N,) index of each point's plane, -1 for none.
        planes: planes of the points.
        cell: cell size, metres.
        rise: metres.
    """
    for p in np.flatnonzero(np.abs(planes.normal[:, 2]) <= WALL_MAX_NORMAL_Z):
        normal, points = planes.normal[p], xyz[which == p].astype(np.float64)
        along = np.array([-normal[1], normal[0], 0.0]) / np.hypot(*normal[:2])
        up = np.cross(normal, along)
        up *= np.sign(up[2])
        s, t = points @ along / cell, points @ up / cell
        lowest = np.rint(t.min())  # rows coincide with layers of voxels, wherever the lowest sample is
        row, column = (np.rint(t) - lowest).astype(int), np.rint(s - s.min()).astype(int)
        known = np.zeros((row.max() + 1 + round(rise / cell), column.max() + 1), bool)
        known[row, column] = True
        corner = planes.offset[p] * normal + s.min() * cell * along + lowest * cell * up
        yield Wall(int(p), corner, along, up, normal, cell, known)


@dataclass(frozen=True)
class Rays:
    """Rays of the scanner, one per thinned point.

    Attributes:
        origin: (N, 3) scanner positions, local metres.
        end: (N, 3) returns, local metres.
        limit: (3,) coefficients of the highest elevation (radians): constant, cosine and sine of the azimuth. The
            highest rays form a cone that is tilted with the scanner.
    """

    origin: F64
    end: F64
    limit: F64

    @staticmethod
    def of(origin: F64, end: F32) -> Rays:
        """Build rays, and estimate their upper limit from them."""
        ray = end.astype(np.float64) - origin
        azimuth, elevation, level = _directions(ray)
        bins = np.floor((azimuth / (2 * np.pi) + 0.5) * LIMITS.azimuth_bins).astype(int) % LIMITS.azimuth_bins
        terms, max_elevation = [], []
        for k in range(LIMITS.azimuth_bins):
            own = (bins == k) & (level > LIMITS.min_range_m)
            if own.sum() >= LIMITS.min_bin_points:
                middle = ((k + 0.5) / LIMITS.azimuth_bins - 0.5) * 2 * np.pi
                terms.append((1.0, np.cos(middle), np.sin(middle)))
                max_elevation.append(np.percentile(elevation[own], 99.8))
        if len(terms) < 3:
            return Rays(origin, end.astype(np.float64), np.array([np.pi / 2, 0.0, 0.0]))
        columns, values = np.array(terms), np.array(max_elevation)
        limit, fits = np.zeros(3), np.ones(len(values), bool)
        for _ in range(10):  # robust: where no object is high, the highest rays have no returns
            limit = np.linalg.lstsq(columns[fits], values[fits], rcond=None)[0]
            off = values - columns @ limit
            fits = off >= min(-LIMITS.elevation_tolerance_rad, float(np.sort(off)[-3]))
        return Rays(origin, end.astype(np.float64), limit)

    def max_heights(self, which: I64) -> tuple[F64, F64]:
        """Heights (K,) of the highest rays at the returns of rays `which`, and horizontal distances (K,), metres."""
        ray = self.end[which] - self.origin[which]
        azimuth, _, level = _directions(ray)
        elevation = np.stack([np.ones(len(azimuth)), np.cos(azimuth), np.sin(azimuth)], axis=1) @ self.limit
        return self.origin[which, 2] + level * np.tan(np.minimum(elevation, 1.5)), level


def _directions(ray: F64) -> tuple[F64, F64, F64]:
    """Azimuth and elevation in radians, and horizontal length of rays (N, 3)."""
    level = np.hypot(ray[:, 0], ray[:, 1])
    return np.arctan2(ray[:, 1], ray[:, 0]), np.arctan2(ray[:, 2], level), level


def max_rows(wall: Wall, rays: Rays, own: I64) -> I32:
    """Highest row (C,) that each column may be extended to.

    Unlimited where the scanned part ends at the scanner's highest rays, else up to the next ray above it.

    Args:
        wall: the wall.
        rays: rays of all points.
        own: (N,) indices of the rays that end on the wall.
    """
    rows, columns = wall.known.shape
    column = wall.column_of(rays.end[own])
    height, level = rays.max_heights(own)
    order = np.lexsort((height, column))
    first = np.searchsorted(column[order], np.arange(columns + 1))
    columns_with_rays = np.flatnonzero(first[1:] > first[:-1])
    far = order[
        first[columns_with_rays] + 3 * (first[columns_with_rays + 1] - first[columns_with_rays]) // 4
    ]  # the ray at the 75th percentile of height
    above = np.maximum(LIMITS.top_tolerance_cells * wall.cell, LIMITS.top_tolerance_rad * level[far])
    open_, between = np.zeros(columns), np.zeros(columns)
    open_[columns_with_rays] = wall.places(wall.ends[columns_with_rays], columns_with_rays)[:, 2] >= height[far] - above
    between = np.interp(np.arange(columns), columns_with_rays, above / wall.cell)
    ends = wall.ends + np.rint(between).astype(np.int32)
    return np.where(_smoothed_along_wall(open_, wall.cell) > 0.5, rows - 1, np.minimum(ends, rows - 1)).astype(np.int32)


def solid(wall: Wall, through: Bools) -> Bools:
    """(C,) bool, True for columns where few rays passed `through` the scanned part (majority over neighbours)."""
    rows = np.arange(len(wall.known))[:, None]
    below = (rows <= wall.ends) & (wall.known | through)
    seen_through = (below & through).sum(axis=0) > LIMITS.max_open_fraction * below.sum(axis=0)
    return np.asarray(_smoothed_along_wall(seen_through, wall.cell) < 0.5)


def cells_passed_through(wall: Wall, rays: Rays) -> Bools:
    """(R, C) bool, cells that rays passed through and ended behind the wall."""
    out = np.zeros(wall.known.shape, np.bool_)
    _mark_crossings(
        out,
        rays.origin,
        rays.end,
        wall.corner,
        wall.normal,
        wall.up / wall.cell,
        wall.along / wall.cell,
        LIMITS.min_behind_m,
    )
    return out


@njit(cache=True)
def _mark_crossings(
    out: Bools, origin: F64, end: F64, corner: F64, normal: F64, up: F64, along: F64, min_behind: float
) -> None:
    """Mark in `out` (R, C) the cells of a plane that rays cross from the front and end `min_behind` metres behind."""
    rows, columns = out.shape
    for i in range(len(end)):
        before, behind = 0.0, 0.0
        for k in range(3):
            before += (origin[i, k] - corner[k]) * normal[k]
            behind += (end[i, k] - corner[k]) * normal[k]
        if before <= 0 or behind >= -min_behind:
            continue
        fraction = before / (before - behind)
        row, column = 0.0, 0.0
        for k in range(3):
            beyond = origin[i, k] + fraction * (end[i, k] - origin[i, k]) - corner[k]
            row += beyond * up[k]
            column += beyond * along[k]
        row, column = np.rint(row), np.rint(column)
        if 0 <= row < rows and 0 <= column < columns:
            out[int(row), int(column)] = True


def gap_cells(known: Bools, through: Bools, radius: int) -> Bools:
    """(R, C) bool, cells of gaps in the `known` part of a wall narrower than twice `radius` (closing).

    Cells that rays passed `through`, and their neighbours, are excluded.
    """
    if radius < 1:
        return np.zeros_like(known)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    whole = cv2.morphologyEx(np.pad(known, radius).astype(np.uint8), cv2.MORPH_CLOSE, disc)
    open_ = cv2.dilate(through.astype(np.uint8), np.ones((3, 3)))
    return np.asarray((whole[radius:-radius, radius:-radius] > 0) & ~known & (open_ == 0))


def top_rows(value: F32, edge: F32, min_row: I32, max_row: I32) -> I32:
    """Top row (C,) of each column, by dynamic programming over the columns.

    Maximizes the sum of `value` below the top plus a reward for an `edge`, minus the cost of height differences.

    Args:
        value: (R, C) evidence of each cell for the wall.
        edge: (R, C) from 0 to 1, strength of the image edge above each cell.
        min_row, max_row: (C,) range of each top row.
    """
    rows, columns = value.shape
    row = np.arange(rows)
    gain = np.cumsum(value, axis=0, dtype=np.float64)
    step = np.minimum(LIMITS.step_cost * np.abs(row[:, None] - row), LIMITS.max_step_cost)
    cost, back = np.zeros(rows), np.zeros((columns, rows), np.int64)
    for c in range(columns):
        through = cost + step
        back[c] = np.argmin(through, axis=1)
        cost = through[row, back[c]]
        cost = cost - gain[:, c] - LIMITS.edge_reward * edge[:, c]
        cost[(row < min_row[c]) | (row > max_row[c])] = np.inf
    out = np.empty(columns, np.int32)
    out[-1] = np.argmin(cost)
    for c in range(columns - 1, 0, -1):
        out[c - 1] = back[c, out[c]]
    return out


def _smoothed_along_wall(values: npt.NDArray[Any], cell: float) -> F32:
    """Moving average (C,) of values over `smoothing_m` along a wall."""
    width = 2 * round(LIMITS.smoothing_m / cell / 2) + 1
    row = np.asarray(values, np.float32)[None]
    return np.asarray(cv2.blur(row, (width, 1), borderType=cv2.BORDER_REPLICATE)[0], np.float32)
