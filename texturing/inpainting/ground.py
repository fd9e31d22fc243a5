"""The ground from above, while its pages are painted: what photos saw of it goes on where none did.

Import late: it loads numba.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numba import njit

from scan2sim.pipeline.core.types import F32, F64, I32, I64, U8, Bools, Mesh
from scan2sim.pipeline.geometry.height_map import MOST, drawn, grown
from scan2sim.texturing.bake.texel_map import frame
from scan2sim.texturing.inpainting.hole_filling import FILLED, FROM_POINTS, SEEN, Page, texel_places
from scan2sim.texturing.inpainting.patch_offsets import FACTOR, continued

CELL = 0.03
"""Metres of the picture's cells: grain, joints and markings, for a fraction of the texels."""
RIM = 1.0
"""Metres around what is to be filled within which texels coloured from points are thought of as filled, too: so holes
reach to what photos saw, and have its tone."""

BESIDE = 2.5
"""Metres around what was taken out within which points, where no photo shows the ground, may have its colours."""


class Plan:
    """A picture of the ground from above.

    Args:
        mesh: the ground's.
        texel: metres.
        xyz, classification: places (N, 3) and classes (N,) of its points: road isn't continued by grass.
        stood: outlines (K, 2) of what stood there and was taken out: photos know but the black below.
    """

    def __init__(self, mesh: Mesh, texel: float, xyz: F32, classification: U8, stood: Sequence[F64] = ()) -> None:
        low, high = mesh.vertices[:, :2].min(axis=0), mesh.vertices[:, :2].max(axis=0)
        self.cell = max(CELL, texel, float(np.sqrt(np.prod(high - low + 1) / MOST)))
        self.low, self._xyz, self._classification = low.astype(np.float64), xyz, classification
        columns, rows = (np.ceil((high - low) / self.cell).astype(int) + 1).tolist()
        self._sum, self._count = np.zeros((rows, columns, 3), np.float32), np.zeros((rows, columns), np.float32)
        self._wanted, self._from_points = np.zeros((rows, columns), bool), np.zeros((rows, columns), bool)
        self._stood = drawn([(ring - self.low) / self.cell for ring in stood], (rows, columns))
        self._beside = grown(self._stood, BESIDE / self.cell)

    def beside(self, places: F32) -> Bools:
        """(N,) which places (N, 3) are where something stood that was taken out, or beside it."""
        return np.asarray(self._beside[self.at(places)], bool)

    def clear(self, page: Page) -> None:
        """Forget what photos saw below things that were taken out, in place."""
        if self._stood.any():
            _clear(page.seen, page.owner, page.flat, page.corners, self.low, self.cell, self._stood)

    def add(self, page: Page) -> None:
        """Take up what a page shows, and where it has been filled for want of something better."""
        _add(
            page.rgb, page.seen, page.owner, page.flat, page.corners, self.low, self.cell,
            self._sum, self._count, self._wanted, self._from_points,
        )  # fmt: skip

    def go_on(self) -> Continued | None:
        """The ground as it goes on where no photo saw it; None where none is wanted, or nothing is known."""
        known = self._count > 0
        self._wanted &= ~known
        if not self._wanted.any() or not known.any():
            return None
        rgb = (self._sum / np.maximum(self._count, 1)[..., None]).astype(np.float32)
        rim = self._from_points & ~known & grown(self._wanted, RIM / self.cell)
        picture, filled = continued(rgb, known, _whole(self._wanted | rim, known), self._kind())
        return Continued(self, picture.astype(np.uint8), filled)

    def _kind(self) -> I32:
        """Class of the nearest point for every coarse cell; -1 far from all."""
        from scipy import ndimage

        shape = tuple(-(-n // FACTOR) for n in self._count.shape)
        kind = np.full(shape, -1, np.int32)
        if not len(self._xyz):
            return kind
        y, x = self.at(self._xyz)
        kind[y // FACTOR, x // FACTOR] = self._classification
        nearest = ndimage.distance_transform_edt(kind < 0, return_distances=False, return_indices=True)
        return kind[tuple(nearest)]

    def at(self, places: F32) -> tuple[I64, I64]:
        """Rows and columns (N,) of places (N, 3)."""
        index = np.floor((places[:, :2] - self.low) / self.cell).astype(np.int64)
        rows, columns = self._count.shape
        return index[:, 1].clip(0, rows - 1), index[:, 0].clip(0, columns - 1)


class Continued:
    """The ground as it goes on: lends its colours to texels that nothing better is known of."""

    def __init__(self, plan: Plan, picture: U8, filled: Bools) -> None:
        self._plan, self._picture, self._filled = plan, picture, filled

    def fill(self, page: Page) -> None:
        """Colour the texels that are marked filled, in place, where the ground was continued."""
        height = len(page.owner)
        for first in range(0, height, 1024):
            row, column = np.nonzero(page.seen[first : first + 1024] == FILLED)
            row += first
            y, x = self._plan.at(texel_places(page.owner, page.flat, page.corners, row, column))
            here = self._filled[y, x]
            page.rgb[row[here], column[here]] = self._picture[y[here], x[here]]


@njit(cache=True, inline="always")
def _cell_of(
    origin: F64, per_x: F64, per_y: F64, x: float, y: float, low: F64, cell: float, shape: tuple[int, ...]
) -> tuple[int, int]:
    """Row and column of a texel in the picture; `origin`, `per_x`, `per_y` are its face's (`texels.frame`)."""
    row = math.floor((origin[1] + x * per_x[1] + y * per_y[1] - low[1]) / cell)
    column = math.floor((origin[0] + x * per_x[0] + y * per_y[0] - low[0]) / cell)
    return min(max(row, 0), shape[0] - 1), min(max(column, 0), shape[1] - 1)


@njit(cache=True)
def _clear(seen: U8, owner: I32, flat: F32, corners: F32, low: F64, cell: float, stood: Bools) -> None:
    last = -1
    for y in range(seen.shape[0]):
        for x in range(seen.shape[1]):
            if seen[y, x] != SEEN:
                continue
            if owner[y, x] != last:
                last = owner[y, x]
                origin, per_x, per_y, _ = frame(flat, corners, last)
            if stood[_cell_of(origin, per_x, per_y, x, y, low, cell, stood.shape)]:
                seen[y, x] = 0


@njit(cache=True)
def _add(
    rgb: U8,
    seen: U8,
    owner: I32,
    flat: F32,
    corners: F32,
    low: F64,
    cell: float,
    total: F32,
    count: F32,
    wanted: Bools,
    from_points: Bools,
) -> None:
    last = -1
    for y in range(seen.shape[0]):
        for x in range(seen.shape[1]):
            if seen[y, x] == 0:
                continue
            if owner[y, x] != last:
                last = owner[y, x]
                origin, per_x, per_y, _ = frame(flat, corners, last)
            at = _cell_of(origin, per_x, per_y, x, y, low, cell, count.shape)
            if seen[y, x] == SEEN:
                count[at] += 1
                for k in range(3):
                    total[at[0], at[1], k] += rgb[y, x, k]
            elif seen[y, x] == FROM_POINTS:
                from_points[at] = True
            else:
                wanted[at] = True


def _whole(wanted: Bools, known: Bools) -> Bools:
    """What is wanted, without pinholes: cells that no texel's middle fell into."""
    import cv2

    any_ = np.asarray(cv2.morphologyEx((wanted | known).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)))
    return (any_ > 0) & ~known
