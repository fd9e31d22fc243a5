"""Ground inpainting: an orthophoto of the ground is collected from its pages, and its holes are inpainted.

Import late: it loads numba.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numba import njit

from scan2sim.pipeline.core.types import F32, F64, I32, I64, U8, Bools, Mesh
from scan2sim.pipeline.geometry.height_map import MAX_CELLS, dilate, rasterize_polygons
from scan2sim.texturing.inpainting.hole_filling import texel_points
from scan2sim.texturing.inpainting.patch_offsets import COARSE_FACTOR, inpaint
from scan2sim.texturing.texel_map import frame
from scan2sim.texturing.texture_page import FILLED, FROM_POINTS, SEEN, Page

CELL_M = 0.03
"""Smallest cell size of the orthophoto in metres: fine enough for grain, joints and markings, coarser than texels."""
POINT_COLOUR_MARGIN_M = 1.0
"""Metres around holes within which texels coloured from points are inpainted as well, so that holes border on texels
that photos saw, and get their tone."""
REMOVED_MARGIN_M = 2.5
"""Metres around removed objects within which points may have the colour of the object or of its shadow."""


class GroundOrthophoto:
    """Orthophoto of the ground.

    Args:
        mesh: mesh of the ground.
        texel: texel size in metres.
        xyz, classification: positions (N, 3) and classes (N,) of the ground points, so that road isn't inpainted with
            grass.
        removed: outlines (K, 2) of removed vehicles and people: photos show only the dark ground below them.
    """

    def __init__(self, mesh: Mesh, texel: float, xyz: F32, classification: U8, removed: Sequence[F64] = ()) -> None:
        low, high = mesh.vertices[:, :2].min(axis=0), mesh.vertices[:, :2].max(axis=0)
        self.cell = max(CELL_M, texel, float(np.sqrt(np.prod(high - low + 1) / MAX_CELLS)))
        self.low, self._xyz, self._classification = low.astype(np.float64), xyz, classification
        sides = np.ceil((high - low) / self.cell).astype(int) + 1
        columns, rows = (COARSE_FACTOR * -(-sides // COARSE_FACTOR)).tolist()  # so that `inpaint` works in place
        self._sum, self._count = np.zeros((rows, columns, 3), np.float32), np.zeros((rows, columns), np.float32)
        self._holes, self._from_points = np.zeros((rows, columns), bool), np.zeros((rows, columns), bool)
        self._removed = rasterize_polygons([(ring - self.low) / self.cell for ring in removed], (rows, columns))
        self._near_removed = dilate(self._removed, REMOVED_MARGIN_M / self.cell)

    def near_removed(self, points: F32) -> Bools:
        """(N,) which points (N, 3) are within `REMOVED_MARGIN_M` of a removed object."""
        return np.asarray(self._near_removed[self.cell_of(points)], bool)

    def clear_removed(self, page: Page) -> None:
        """Mark the texels below removed objects as not seen by photos, in place."""
        if self._removed.any():
            _clear(page.seen, page.owner, page.flat, page.corners, self.low, self.cell, self._removed)

    def add(self, page: Page) -> None:
        """Add the colours of a page, and its holes (texels marked as filled)."""
        _add(
            page.rgb, page.seen, page.owner, page.flat, page.corners, self.low, self.cell,
            self._sum, self._count, self._holes, self._from_points,
        )  # fmt: skip

    def inpaint(self) -> InpaintedGround | None:
        """Inpaint the holes; None if there are no holes, or no photo saw the ground. Once, after all pages."""
        known = self._count > 0
        self._holes &= ~known
        if not self._holes.any() or not known.any():
            return None
        rgb, self._sum = self._sum, np.zeros((0, 0, 3), np.float32)
        rgb /= np.maximum(self._count, 1)[..., None]
        rim = self._from_points & ~known & dilate(self._holes, POINT_COLOUR_MARGIN_M / self.cell)
        image, filled = inpaint(rgb, known, _without_pinholes(self._holes | rim, known), self._classes())
        return InpaintedGround(self, image.astype(np.uint8), filled)

    def _classes(self) -> I32:
        """Class of the nearest point for every coarse cell; -1 if there are no points."""
        from scipy import ndimage

        shape = tuple(-(-n // COARSE_FACTOR) for n in self._count.shape)
        classes = np.full(shape, -1, np.int32)
        if not len(self._xyz):
            return classes
        y, x = self.cell_of(self._xyz)
        classes[y // COARSE_FACTOR, x // COARSE_FACTOR] = self._classification
        nearest = ndimage.distance_transform_edt(classes < 0, return_distances=False, return_indices=True)
        return classes[tuple(nearest)]

    def cell_of(self, points: F32) -> tuple[I64, I64]:
        """Rows and columns (N,) of points (N, 3), clipped to the orthophoto."""
        index = np.floor((points[:, :2] - self.low) / self.cell).astype(np.int64)
        rows, columns = self._count.shape
        return index[:, 1].clip(0, rows - 1), index[:, 0].clip(0, columns - 1)


class InpaintedGround:
    """Inpainted orthophoto of the ground, which colours the texels that neither photos nor points coloured."""

    def __init__(self, orthophoto: GroundOrthophoto, image: U8, filled: Bools) -> None:
        self._orthophoto, self._image, self._filled = orthophoto, image, filled

    def fill(self, page: Page) -> None:
        """Colour the texels marked as filled where the orthophoto was inpainted, in place."""
        height = len(page.owner)
        for first in range(0, height, 1024):
            row, column = np.nonzero(page.seen[first : first + 1024] == FILLED)
            row += first
            y, x = self._orthophoto.cell_of(texel_points(page.owner, page.flat, page.corners, row, column))
            inside = self._filled[y, x]
            page.rgb[row[inside], column[inside]] = self._image[y[inside], x[inside]]


@njit(cache=True, inline="always")
def _cell_of(
    origin: F64, per_x: F64, per_y: F64, x: float, y: float, low: F64, cell: float, shape: tuple[int, ...]
) -> tuple[int, int]:
    """Row and column of a texel in the orthophoto; `origin`, `per_x`, `per_y` of its face from `texel_map.frame`."""
    row = math.floor((origin[1] + x * per_x[1] + y * per_y[1] - low[1]) / cell)
    column = math.floor((origin[0] + x * per_x[0] + y * per_y[0] - low[0]) / cell)
    return min(max(row, 0), shape[0] - 1), min(max(column, 0), shape[1] - 1)


@njit(cache=True)
def _clear(seen: U8, owner: I32, flat: F32, corners: F32, low: F64, cell: float, removed: Bools) -> None:
    last = -1
    for y in range(seen.shape[0]):
        for x in range(seen.shape[1]):
            if seen[y, x] != SEEN:
                continue
            if owner[y, x] != last:
                last = owner[y, x]
                origin, per_x, per_y, _ = frame(flat, corners, last)
            if removed[_cell_of(origin, per_x, per_y, x, y, low, cell, removed.shape)]:
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
    holes: Bools,
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
                holes[at] = True


def _without_pinholes(holes: Bools, known: Bools) -> Bools:
    """Holes extended by pinholes: cells that contain no texel centre."""
    import cv2

    any_ = np.asarray(cv2.morphologyEx((holes | known).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)))
    return (any_ > 0) & ~known
