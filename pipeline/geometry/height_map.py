"""Height maps: rasters in plan view with heights, masks, morphology, and interpolation of holes.

Cells are aligned to multiples of their size, so that tiles of a survey, whose origins are whole metres, have the same
cells. Arrays are (rows, columns): y increases with the row, x with the column.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.types import F32, F64, I64, Bools

CELL_SIZES_M = (0.1, 0.2, 0.25, 0.5, 1.0)
"""Allowed cell sizes; a metre is a multiple of each."""
SPACING_SAMPLES = 20_000
"""Number of points that the point spacing is estimated from."""
LATTICE_SPACING_CELLS = 1.2
"""Mean distance to six neighbours on a square lattice, in cells."""
MARGIN_CELLS = 4
"""Empty cells around the data."""
MAX_CELLS = 2 * 10**8
"""Maximum size of a raster: several of them in float64 have to fit into memory."""


@dataclass(frozen=True)
class Raster:
    """Position and size of a raster.

    Attributes:
        cell: cell size, metres.
        low: (x, y) of the first cell's corner, in cells, local coordinates.
        shape: rows, columns.
    """

    cell: float
    low: tuple[int, int]
    shape: tuple[int, int]

    @classmethod
    def over(cls, cell: float, parts: Sequence[npt.NDArray[Any]]) -> Raster:
        """Raster that contains all points of `parts` (N, 2 or 3), with a margin.

        Raises:
            DataError: it would have more than `MAX_CELLS` cells.
        """
        filled = [part[:, :2] for part in parts if len(part)]
        low = np.floor(np.min([part.min(axis=0) for part in filled], axis=0) / cell).astype(int) - MARGIN_CELLS
        high = np.floor(np.max([part.max(axis=0) for part in filled], axis=0) / cell).astype(int) + MARGIN_CELLS + 1
        columns, rows = int(high[0] - low[0]), int(high[1] - low[1])
        if rows * columns > MAX_CELLS:
            raise DataError(
                "the cloud",
                f"covers {columns * cell:,.0f} x {rows * cell:,.0f} m: {rows * columns:,} cells of {cell:g} m are too "
                "many for the completion of walls and ground",
                "Cut it into tiles (scan2sim tile), or set ground.when and walls.when to never",
            )
        return cls(cell, (int(low[0]), int(low[1])), (rows, columns))

    def at(self, xy: npt.NDArray[Any]) -> tuple[I64, I64]:
        """Rows and columns (N,) of points (N, 2 or 3), clipped to the raster."""
        index = np.floor(np.asarray(xy)[:, :2].astype(np.float64) / self.cell + 1e-6).astype(np.int64) - self.low
        return index[:, 1].clip(0, self.shape[0] - 1), index[:, 0].clip(0, self.shape[1] - 1)

    def centres(self, mask: Bools) -> F64:
        """Centres (N, 2) of the cells selected by `mask`, row by row."""
        row, column = np.nonzero(mask)
        return np.asarray((np.column_stack([column, row]) + self.low + 0.5) * self.cell, np.float64)

    def covered(self, xy: npt.NDArray[Any]) -> Bools:
        """Mask of the cells that contain one of the points (N, 2 or 3)."""
        out = np.zeros(self.shape, bool)
        out[self.at(xy)] = True
        return out

    def highest(self, xyz: F32) -> F64:
        """Maximum height of the points (N, 3) in each cell; NaN in empty cells."""
        out = np.full(self.shape, -np.inf)
        np.maximum.at(out, self.at(xyz), xyz[:, 2].astype(np.float64))
        return np.where(np.isfinite(out), out, np.nan)

    def lowest(self, xyz: F32) -> F64:
        """Minimum height of the points (N, 3) in each cell; NaN in empty cells."""
        return -self.highest(xyz * np.array([1, 1, -1], np.float32))

    def mean(self, xyz: F32, values: npt.NDArray[Any]) -> F64:
        """Means (rows, columns, K) of the values (N, K) of the points in each cell; NaN in empty cells."""
        row, column = self.at(xyz)
        flat, n = row * self.shape[1] + column, self.shape[0] * self.shape[1]
        count = np.bincount(flat, minlength=n).astype(np.float64)
        count[count == 0] = np.nan
        sums = [np.bincount(flat, weights=v.astype(np.float64), minlength=n) / count for v in values.T]
        return np.stack(sums, axis=1).reshape(*self.shape, -1)


def point_spacing(xyz: F32) -> float:
    """Typical spacing of points (N, 3) in metres, rounded to `CELL_SIZES_M`, so that similar clouds have the same."""
    if len(xyz) < 7:
        return CELL_SIZES_M[-1]
    found = exact_point_spacing(xyz)
    return min(CELL_SIZES_M, key=lambda size: abs(np.log(size / max(found, 1e-6))))


def exact_point_spacing(xyz: F32) -> float:
    """Typical distance of neighbouring points (N, 3) in the unit of the coordinates; 0 for fewer than 7 points."""
    from scipy.spatial import cKDTree

    if len(xyz) < 7:
        return 0.0
    tree = cKDTree(xyz, balanced_tree=False, compact_nodes=False)  # several times faster to build
    distance, _ = tree.query(xyz[:: max(1, len(xyz) // SPACING_SAMPLES)], k=7, workers=-1)
    return float(np.median(distance[:, 1:].mean(axis=1))) / LATTICE_SPACING_CELLS


def rasterize_polygons(rings: Sequence[npt.NDArray[np.floating]], shape: tuple[int, int]) -> Bools:
    """Mask of polygons (K, 2), x and y in cells from the first cell's corner."""
    import cv2

    mask = np.zeros(shape, np.uint8)
    if rings:
        cv2.fillPoly(mask, [np.floor(ring).astype(np.int32) for ring in rings], 1)
    return mask > 0


def dilate(mask: Bools, radius: float) -> Bools:
    """Dilate a mask by a radius in cells."""
    return np.asarray(_distance_to(mask) <= radius, bool) if mask.any() else mask


def _distance_to(mask: Bools) -> F32:
    """Distance of each cell to the nearest cell of a mask, in cells."""
    import cv2

    return np.asarray(cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE), np.float32)


def close_gaps(mask: Bools, radius: float) -> Bools:
    """Close gaps in a mask that are narrower than twice the radius, in cells (morphological closing)."""
    padding = math.ceil(radius) + 1
    dilated = dilate(np.pad(mask, padding), radius)
    return np.asarray(_distance_to(~dilated) > radius, bool)[padding:-padding, padding:-padding] | mask


def fill_membrane(values: F64, wanted: Bools) -> F64:
    """Fill the `wanted` cells of values (rows, columns, K) by solving Laplace's equation (a membrane).

    Known cells (not NaN) are Dirichlet conditions; the slope is zero towards cells that are neither known nor wanted.
    Wanted regions that touch no known cell stay NaN.
    """
    from scipy import ndimage
    from scipy.sparse import coo_matrix
    from scipy.sparse.linalg import splu

    known = np.isfinite(values[..., 0])
    wanted = wanted & ~known
    piece, count = ndimage.label(wanted)
    touching = np.unique(piece[wanted & ndimage.binary_dilation(known)])
    wanted &= np.isin(piece, touching[touching > 0]) if count else False
    out = values.copy()
    n = int(wanted.sum())
    if n == 0:
        return out
    number = np.full(wanted.shape, -1)
    number[wanted] = np.arange(n)
    diagonal, right = np.zeros(n), np.zeros((n, values.shape[2]))
    rows, columns = [], []
    for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
        other, given, value = (_shift(a, axis, step, fill) for a, fill in ((number, -1), (known, False), (values, 0)))
        inner, rim = wanted & (other >= 0), wanted & given
        diagonal += (inner | rim)[wanted]
        rows.append(number[inner])
        columns.append(other[inner])
        np.add.at(right, number[rim], value[rim])
    i, j = np.concatenate([*rows, np.arange(n)]), np.concatenate([*columns, np.arange(n)])
    entries = np.concatenate([np.full(sum(map(len, rows)), -1.0), diagonal])
    matrix = coo_matrix((entries, (i, j)), shape=(n, n)).tocsc()
    # the matrix is symmetric and diagonally dominant: without pivoting, the factors stay sparse
    factors = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    out[wanted] = factors.solve(right)
    return out


def _shift(array: npt.NDArray[Any], axis: int, step: int, fill: float) -> npt.NDArray[Any]:
    """The array shifted by one cell; `fill` at the border."""
    out = np.full_like(array, fill)
    to = [slice(None)] * array.ndim
    of = [slice(None)] * array.ndim
    to[axis], of[axis] = (slice(1, None), slice(None, -1)) if step > 0 else (slice(None, -1), slice(1, None))
    out[tuple(to)] = array[tuple(of)]
    return out


def signed_area(ring: npt.NDArray[np.floating]) -> float:
    """Area of a ring (K, 2) in m2, negative if it is clockwise."""
    x, y = (ring - ring[0]).T
    return float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y) / 2)
