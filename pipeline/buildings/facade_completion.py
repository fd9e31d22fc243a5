"""Walls and the scanner's rays: where a wall's scan ends only because the rays do, and where it has gaps.

A wall is an upright plane of the cloud, cut into cells. A column of it may go on above its scan where that ends at the
scanner's uppermost rays; a gap may be closed where no ray went through. How high a column goes is a line over all
columns, solved by dynamic programming: as high as what is told of its cells says, and neighbours alike. Import late: it
loads numba.
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

UPRIGHT = float(np.sin(np.radians(10.0)))
"""|nz| of a wall's plane at most."""
OPENING = 2.0
"""Metres along a wall of the windows and doors in it."""
RAGGED = 3
"""Cells by which a scan's end may be below the uppermost rays."""
SPACING = 0.015
"""Radians likewise: two of a scanner's lines."""
STEADY = 1.0
"""Metres along a wall over which most columns say whether it was reached."""
AZIMUTHS, FEW, CLOSE, LOOSE = 72, 50, 3.0, 0.005
"""Directions in which the uppermost rays are looked for, points of one, metres from which on they count, and radians by
which a direction may be lower: else it shows no more than what stands there."""
SEEN_THROUGH = 0.25
"""Share of its cells that rays went through, beyond which a wall is none."""
DEEP = 0.3
"""Metres behind a wall from which on a ray went through it."""
SHOWN = 2.0
"""What an edge of the picture is worth, in cells of which it is sure that they are the wall's."""
STEP, JUMP = 0.6, 10.0
"""Price of each cell by which neighbouring columns end at different heights, and the most that is paid."""


@dataclass(frozen=True)
class Wall:
    """A wall's plane, cut into square cells, rows upwards.

    Attributes:
        plane: its index.
        corner: (3,) local metres, the middle of cell (0, 0).
        along, up, normal: (3,) unit; `along` is level.
        cell: metres.
        known: (R, C) where it was scanned.
    """

    plane: int
    corner: F64
    along: F64
    up: F64
    normal: F64
    cell: float
    known: Bools

    def part(self, low: int, high: int) -> Wall:
        """Its rows from `low` up to `high`, without it."""
        return replace(self, corner=self.places(low, 0), known=self.known[low:high])

    @cached_property
    def tops(self) -> I32:
        """(C,) the highest scanned row of each column, of those without any between their neighbours'."""
        rows, columns = self.known.shape
        has = np.flatnonzero(self.known.any(axis=0))
        if not len(has):
            return np.zeros(columns, np.int32)
        top = rows - 1 - np.argmax(self.known[::-1, has], axis=0)
        return np.rint(np.interp(np.arange(columns), has, top)).astype(np.int32)

    @cached_property
    def ends(self) -> I32:
        """(C,) the row that the scan of each column ends at; dips narrower than `OPENING`, over windows, are none."""
        width = 2 * round(OPENING / self.cell / 2) + 1
        whole = cv2.morphologyEx(self.tops[None].astype(np.int16), cv2.MORPH_CLOSE, np.ones((1, width), np.uint8))
        return whole[0].astype(np.int32)

    def places(self, row: npt.ArrayLike, column: npt.ArrayLike) -> F64:
        """(..., 3) local metres of places given in cells."""
        r, c = np.asarray(row, np.float64)[..., None], np.asarray(column, np.float64)[..., None]
        return self.corner + self.cell * (r * self.up + c * self.along)

    def column_of(self, xyz: npt.ArrayLike) -> I32:
        """(N,) columns of places (N, 3)."""
        at = np.rint((np.asarray(xyz, np.float64) - self.corner) @ self.along / self.cell)
        return np.clip(at, 0, self.known.shape[1] - 1).astype(np.int32)


def walls(xyz: F32, which: I32, planes: Planes, cell: float, rise: float) -> Iterator[Wall]:
    """The upright planes of a thinned cloud as walls, with room for `rise` metres above what was scanned.

    Args:
        xyz: (N, 3) local metres.
        which: (N,) each point's plane, -1 for none.
        planes: of the points.
        cell: metres.
        rise: metres.
    """
    for p in np.flatnonzero(np.abs(planes.normal[:, 2]) <= UPRIGHT):
        normal, points = planes.normal[p], xyz[which == p].astype(np.float64)
        along = np.array([-normal[1], normal[0], 0.0]) / np.hypot(*normal[:2])
        up = np.cross(normal, along)
        up *= np.sign(up[2])
        s, t = points @ along / cell, points @ up / cell
        row, column = np.rint(t - t.min()).astype(int), np.rint(s - s.min()).astype(int)
        known = np.zeros((row.max() + 1 + round(rise / cell), column.max() + 1), bool)
        known[row, column] = True
        corner = planes.offset[p] * normal + s.min() * cell * along + t.min() * cell * up
        yield Wall(int(p), corner, along, up, normal, cell, known)


@dataclass(frozen=True)
class Rays:
    """The scanner's rays, one a thinned point.

    Attributes:
        origin: (N, 3) local metres, where the scanner was.
        end: (N, 3) local metres, what it hit.
        limit: (3,) of the elevation (radians) that its rays end at: of 1, cosine and sine of their azimuth. The
            uppermost rays are a cone, tilted as the scanner is.
    """

    origin: F64
    end: F64
    limit: F64

    @staticmethod
    def of(origin: F64, end: F32) -> Rays:
        """Rays whose upper limit is told from themselves."""
        ray = end.astype(np.float64) - origin
        azimuth, elevation, level = _directions(ray)
        bins = np.floor((azimuth / (2 * np.pi) + 0.5) * AZIMUTHS).astype(int) % AZIMUTHS
        terms, highest = [], []
        for k in range(AZIMUTHS):
            own = (bins == k) & (level > CLOSE)
            if own.sum() >= FEW:
                middle = ((k + 0.5) / AZIMUTHS - 0.5) * 2 * np.pi
                terms.append((1.0, np.cos(middle), np.sin(middle)))
                highest.append(np.percentile(elevation[own], 99.8))
        if len(terms) < 3:
            return Rays(origin, end.astype(np.float64), np.array([np.pi / 2, 0.0, 0.0]))
        columns, values = np.array(terms), np.array(highest)
        limit, fits = np.zeros(3), np.ones(len(values), bool)
        for _ in range(10):  # where nothing is high, the uppermost rays hit nothing
            limit = np.linalg.lstsq(columns[fits], values[fits], rcond=None)[0]
            off = values - columns @ limit
            fits = off >= min(-LOOSE, float(np.sort(off)[-3]))
        return Rays(origin, end.astype(np.float64), limit)

    def reach(self, which: I64) -> tuple[F64, F64]:
        """Heights that the uppermost rays from the origins of some are at where those end, and how far away: (K,)."""
        ray = self.end[which] - self.origin[which]
        azimuth, _, level = _directions(ray)
        elevation = np.stack([np.ones(len(azimuth)), np.cos(azimuth), np.sin(azimuth)], axis=1) @ self.limit
        return self.origin[which, 2] + level * np.tan(np.minimum(elevation, 1.5)), level


def _directions(ray: F64) -> tuple[F64, F64, F64]:
    """Azimuth and elevation, radians, and level length of rays (N, 3)."""
    level = np.hypot(ray[:, 0], ray[:, 1])
    return np.arctan2(ray[:, 1], ray[:, 0]), np.arctan2(ray[:, 2], level), level


def ceiling(wall: Wall, rays: Rays, own: I64) -> I32:
    """(C,) the highest row that each column may go on to.

    Any where its scan ends as the scanner's rays do, else up to the ray that would have passed above it.

    Args:
        wall: to be raised.
        rays: of all points.
        own: (N,) those that end on the wall.
    """
    rows, columns = wall.known.shape
    column = wall.column_of(rays.end[own])
    height, level = rays.reach(own)
    order = np.lexsort((height, column))
    first = np.searchsorted(column[order], np.arange(columns + 1))
    some = np.flatnonzero(first[1:] > first[:-1])
    far = order[first[some] + 3 * (first[some + 1] - first[some]) // 4]  # of the upper quartile
    above = np.maximum(RAGGED * wall.cell, SPACING * level[far])
    open_, between = np.zeros(columns), np.zeros(columns)
    open_[some] = wall.places(wall.ends[some], some)[:, 2] >= height[far] - above
    between = np.interp(np.arange(columns), some, above / wall.cell)
    ends = wall.ends + np.rint(between).astype(np.int32)
    return np.where(_along(open_, wall.cell) > 0.5, rows - 1, np.minimum(ends, rows - 1)).astype(np.int32)


def solid(wall: Wall, through: Bools) -> Bools:
    """(C,) columns of which, as of most beside them, rays hardly went `through` what was scanned: no fence, no gate."""
    rows = np.arange(len(wall.known))[:, None]
    below = (rows <= wall.ends) & (wall.known | through)
    seen_through = (below & through).sum(axis=0) > SEEN_THROUGH * below.sum(axis=0)
    return np.asarray(_along(seen_through, wall.cell) < 0.5)


def passed(wall: Wall, rays: Rays) -> Bools:
    """(R, C) cells that rays went through, to end behind the wall."""
    out = np.zeros(wall.known.shape, np.bool_)
    _cross(out, rays.origin, rays.end, wall.corner, wall.normal, wall.up / wall.cell, wall.along / wall.cell, DEEP)
    return out


@njit(cache=True)
def _cross(out: Bools, origin: F64, end: F64, corner: F64, normal: F64, up: F64, along: F64, deep: float) -> None:
    """Mark in `out` (R, C) the cells of a plane that rays cross from before it to `deep` metres behind it."""
    rows, columns = out.shape
    for i in range(len(end)):
        before, behind = 0.0, 0.0
        for k in range(3):
            before += (origin[i, k] - corner[k]) * normal[k]
            behind += (end[i, k] - corner[k]) * normal[k]
        if before <= 0 or behind >= -deep:
            continue
        share = before / (before - behind)
        row, column = 0.0, 0.0
        for k in range(3):
            beyond = origin[i, k] + share * (end[i, k] - origin[i, k]) - corner[k]
            row += beyond * up[k]
            column += beyond * along[k]
        row, column = np.rint(row), np.rint(column)
        if 0 <= row < rows and 0 <= column < columns:
            out[int(row), int(column)] = True


def closed(known: Bools, through: Bools, reach: int) -> Bools:
    """(R, C) cells of gaps in what is `known` of a wall, less than twice `reach` cells wide.

    Those that rays went `through` are none, and what is beside them.
    """
    if reach < 1:
        return np.zeros_like(known)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    whole = cv2.morphologyEx(np.pad(known, reach).astype(np.uint8), cv2.MORPH_CLOSE, disc)
    open_ = cv2.dilate(through.astype(np.uint8), np.ones((3, 3)))
    return np.asarray((whole[reach:-reach, reach:-reach] > 0) & ~known & (open_ == 0))


def highest(value: F32, edge: F32, least: I32, most: I32) -> I32:
    """(C,) the row that each column ends at: those with most of `value` below, at an `edge`, neighbours alike.

    Args:
        value: (R, C) of each cell.
        edge: (R, C) from 0 to 1, whether there is an edge above each cell.
        least, most: (C,) rows between which each ends.
    """
    rows, columns = value.shape
    row = np.arange(rows)
    gain = np.cumsum(value, axis=0, dtype=np.float64)
    step = np.minimum(STEP * np.abs(row[:, None] - row), JUMP)
    cost, back = np.zeros(rows), np.zeros((columns, rows), np.int64)
    for c in range(columns):
        through = cost + step
        back[c] = np.argmin(through, axis=1)
        cost = through[row, back[c]]
        cost = cost - gain[:, c] - SHOWN * edge[:, c]
        cost[(row < least[c]) | (row > most[c])] = np.inf
    out = np.empty(columns, np.int32)
    out[-1] = np.argmin(cost)
    for c in range(columns - 1, 0, -1):
        out[c - 1] = back[c, out[c]]
    return out


def _along(values: npt.NDArray[Any], cell: float) -> F32:
    """(C,) means of values over `STEADY` metres along a wall."""
    width = 2 * round(STEADY / cell / 2) + 1
    row = np.asarray(values, np.float32)[None]
    return np.asarray(cv2.blur(row, (width, 1), borderType=cv2.BORDER_REPLICATE)[0], np.float32)
