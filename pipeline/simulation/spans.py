"""Spans: the height range of each triangle within each cell of a grid in plan view (Mononen's Recast, rcSpan).

Every triangle is clipped to the columns of the cells that it crosses, so that a wall that cuts only a corner of a cell
is in that cell, at its exact heights.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from scan2sim.pipeline.core.types import F32, F64, I32, I64, Bools, Mesh


@dataclass(frozen=True)
class Grid:
    """Cells in plan view.

    Attributes:
        origin: (x, y) of the corner of cell (0, 0), metres.
        cell: side of a cell, metres.
        shape: number of rows (along y) and columns (along x).
    """

    origin: tuple[float, float]
    cell: float
    shape: tuple[int, int]

    def index(self, xy: F64) -> I64:
        """(N,) flat index of the cells of points (N, 2), clipped to the grid."""
        column, row = np.floor((xy - np.asarray(self.origin)) / self.cell).astype(np.int64).T
        return row.clip(0, self.shape[0] - 1) * self.shape[1] + column.clip(0, self.shape[1] - 1)

    def centres(self, index: I64) -> F64:
        """(N, 2) centres of cells by flat index (N,)."""
        row, column = np.divmod(index, self.shape[1])
        return np.asarray(np.asarray(self.origin) + (np.column_stack([column, row]) + 0.5) * self.cell)


@dataclass(frozen=True)
class Spans:
    """Spans of a mesh, sorted by cell.

    Attributes:
        cell: (S,) flat index of the cell.
        low, high: (S,) height range, metres.
        face: (S,) index of the triangle.
        area: (S,) share of the cell that the triangle covers in plan view.
        begin: (cells + 1,) first span of each cell.
    """

    cell: I64
    low: F32
    high: F32
    face: I32
    area: F32
    begin: I64


def spans_of(mesh: Mesh, grid: Grid) -> Spans:
    """Spans of a mesh within a grid."""
    corners = mesh.corners.astype(np.float64)
    corners[..., :2] = (corners[..., :2] - np.asarray(grid.origin)) / grid.cell
    rows, columns = grid.shape
    count = _clip(corners, rows, columns, np.zeros(0, np.int64), np.zeros((0, 3), np.float32), np.zeros(0, np.int32))
    cell, found, face = np.empty(count, np.int64), np.empty((count, 3), np.float32), np.empty(count, np.int32)
    _clip(corners, rows, columns, cell, found, face)
    order = np.argsort(cell, kind="stable")
    cell = cell[order]
    begin = np.searchsorted(cell, np.arange(rows * columns + 1))
    low, high, area = np.ascontiguousarray(found[order].T)
    return Spans(cell, low, high, face[order], area, begin)


def blocked(spans: Spans, cell: I64, low: F32, high: F32) -> Bools:
    """(N,) whether a surface is between heights `low` and `high` (N,) in cells (N,)."""
    return np.asarray(_any_between(spans.begin, spans.low, spans.high, cell, low, high))


@njit(cache=True)
def _any_between(begin: I64, low: F32, high: F32, cell: I64, a: F32, b: F32) -> Bools:
    found = np.zeros(len(cell), np.bool_)
    for i in range(len(cell)):
        for k in range(begin[cell[i]], begin[cell[i] + 1]):
            if low[k] < b[i] and high[k] > a[i]:
                found[i] = True
                break
    return found


@njit(cache=True)
def _cut(polygon: F64, count: int, axis: int, at: float, sign: float, out: F64) -> int:
    """Part of a convex polygon where sign * (coordinate - at) >= 0; returns its number of corners."""
    kept = 0
    for i in range(count):
        j = (i + 1) % count
        a, b = sign * (polygon[i, axis] - at), sign * (polygon[j, axis] - at)
        if a >= 0:
            out[kept] = polygon[i]
            kept += 1
        if (a > 0 and b < 0) or (a < 0 and b > 0):
            t = a / (a - b)
            for d in range(3):
                out[kept, d] = polygon[i, d] + t * (polygon[j, d] - polygon[i, d])
            kept += 1
    return kept


@njit(cache=True)
def _clip(corners: F64, rows: int, columns: int, cell: I64, found: F32, face: I32) -> int:
    """Clip triangles (F, 3, 3), plan coordinates in cells; returns the number of spans, written if there is space.

    `found` (S, 3): lowest and highest height, area in plan view.
    """
    strip, left, part, right = np.empty((8, 3)), np.empty((8, 3)), np.empty((10, 3)), np.empty((10, 3))
    total, write = 0, len(cell) > 0
    for f in range(len(corners)):
        triangle = corners[f]
        first_row = max(0, int(np.floor(triangle[:, 1].min())))
        last_row = min(rows - 1, int(np.floor(triangle[:, 1].max())))
        for row in range(first_row, last_row + 1):
            n = _cut(triangle, 3, 1, float(row), 1.0, left)
            n = _cut(left, n, 1, row + 1.0, -1.0, strip)
            if n == 0:
                continue
            first, last = max(0, int(np.floor(strip[:n, 0].min()))), min(columns - 1, int(np.floor(strip[:n, 0].max())))
            for column in range(first, last + 1):
                m = _cut(strip, n, 0, float(column), 1.0, right)
                m = _cut(right, m, 0, column + 1.0, -1.0, part)
                if m == 0:
                    continue
                if write:
                    cell[total] = row * columns + column
                    found[total, 0], found[total, 1] = part[:m, 2].min(), part[:m, 2].max()
                    area = 0.0
                    for i in range(m):
                        j = (i + 1) % m
                        area += part[i, 0] * part[j, 1] - part[j, 0] * part[i, 1]
                    found[total, 2] = abs(area) / 2
                    face[total] = f
                total += 1
    return total
