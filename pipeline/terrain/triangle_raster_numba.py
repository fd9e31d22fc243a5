"""Compiled loop over the cells of triangles (numba)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from scan2sim.pipeline.core.types import F64, I64


def rasterize_triangles(corners: I64, values: F64, shape: tuple[int, int]) -> tuple[I64, F64]:
    """Triangle (rows, columns) in which each cell's centre lies, -1 for none, and the interpolated value (NaN).

    Args:
        corners: (F, 3, 2) rows and columns of the corners.
        values: (F, 3) values at the corners.
        shape: rows, columns.
    """
    own, found = np.full(shape, -1, np.int64), np.full(shape, np.nan)
    _fill(corners.astype(np.int64), values.astype(np.float64), own, found)
    return own, found


@njit(cache=True)
def _fill(corners: Any, values: Any, own: Any, found: Any) -> None:
    for f in range(len(corners)):
        ay, ax = corners[f, 0]
        by, bx = corners[f, 1]
        cy, cx = corners[f, 2]
        det = (by - ay) * (cx - ax) - (bx - ax) * (cy - ay)
        if det == 0:
            continue
        for row in range(min(ay, by, cy), max(ay, by, cy) + 1):
            for column in range(min(ax, bx, cx), max(ax, bx, cx) + 1):
                dy, dx = row - ay, column - ax
                u = (dy * (cx - ax) - dx * (cy - ay)) / det
                v = ((by - ay) * dx - (bx - ax) * dy) / det
                if u >= 0 and v >= 0 and u + v <= 1 + 1e-12:
                    own[row, column] = f
                    found[row, column] = values[f, 0] * (1 - u - v) + values[f, 1] * u + values[f, 2] * v
