"""Rasterisation of faces onto texture pages: maps texels to faces and to 3D points. Import late: it loads numba.

The centre of texel (x, y) of a page of W x H texels is at u = (x + 0.5) / W, v = 1 - (y + 0.5) / H.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from scan2sim.pipeline.core.types import F32, F64, I32, I64, U8

BAND_ROWS = 32
"""Rows of a page that one thread rasterises at a time."""


def corners(uv: F32, width: int, height: int) -> F32:
    """(F, 3, 2) float32 positions of the faces' corners on a page, in texels (x right, y down, centres at integers)."""
    return np.stack([uv[..., 0] * width - 0.5, (1 - uv[..., 1]) * height - 0.5], axis=-1).astype(np.float32)


def owners(flat: F32, width: int, height: int) -> I32:
    """(H, W) int32 face, index into `flat` (F, 3, 2), that covers each texel's centre; -1 where there is none."""
    out = np.full((height, width), -1, np.int32)
    _own(flat, out)
    return out


@njit(cache=True)
def box(flat: F32, f: int, width: int, height: int) -> tuple[int, int, int, int]:
    """Bounding box of face f in texels, clipped to the page: x0, y0, x1, y1, inclusive."""
    x0 = min(flat[f, 0, 0], flat[f, 1, 0], flat[f, 2, 0])
    x1 = max(flat[f, 0, 0], flat[f, 1, 0], flat[f, 2, 0])
    y0 = min(flat[f, 0, 1], flat[f, 1, 1], flat[f, 2, 1])
    y1 = max(flat[f, 0, 1], flat[f, 1, 1], flat[f, 2, 1])
    return (
        max(0, int(math.ceil(x0 - 1e-3))),
        max(0, int(math.ceil(y0 - 1e-3))),
        min(width - 1, int(math.floor(x1 + 1e-3))),
        min(height - 1, int(math.floor(y1 + 1e-3))),
    )


@njit(cache=True, parallel=True)
def _own(flat: F32, owner: I32) -> None:
    height, width = owner.shape
    bands = (height + BAND_ROWS - 1) // BAND_ROWS
    rows = np.empty((len(flat), 2), np.int32)
    for f in prange(len(flat)):
        _, rows[f, 0], _, rows[f, 1] = box(flat, f, width, height)
    for band in prange(bands):  # one thread per band, so no two threads write the same texel
        first, last = band * BAND_ROWS, min(height, (band + 1) * BAND_ROWS) - 1
        for f in range(len(flat)):
            if rows[f, 1] < first or rows[f, 0] > last:
                continue
            ax, ay = np.float64(flat[f, 0, 0]), np.float64(flat[f, 0, 1])
            bx, by = flat[f, 1, 0] - ax, flat[f, 1, 1] - ay
            cx, cy = flat[f, 2, 0] - ax, flat[f, 2, 1] - ay
            det = bx * cy - by * cx
            if abs(det) < 1e-9:
                continue
            x0, y0, x1, y1 = box(flat, f, width, height)
            for y in range(max(first, y0), min(last, y1) + 1):
                for x in range(x0, x1 + 1):
                    s = ((x - ax) * cy - (y - ay) * cx) / det
                    t = (bx * (y - ay) - by * (x - ax)) / det
                    if s >= -1e-6 and t >= -1e-6 and s + t <= 1 + 1e-6 and owner[y, x] < 0:
                        owner[y, x] = f


@njit(cache=True)
def frame(flat: F32, corners: F32, f: int) -> tuple[F64, F64, F64, bool]:
    """Affine map of face f from texels to 3D: origin, step per x and step per y, (3,) each; False if degenerate."""
    ax, ay = np.float64(flat[f, 0, 0]), np.float64(flat[f, 0, 1])
    bx, by = flat[f, 1, 0] - ax, flat[f, 1, 1] - ay
    cx, cy = flat[f, 2, 0] - ax, flat[f, 2, 1] - ay
    det = bx * cy - by * cx
    origin, per_x, per_y = np.zeros(3), np.zeros(3), np.zeros(3)
    if abs(det) < 1e-9:
        return origin, per_x, per_y, False
    for k in range(3):
        e1 = np.float64(corners[f, 1, k]) - corners[f, 0, k]
        e2 = np.float64(corners[f, 2, k]) - corners[f, 0, k]
        per_x[k] = (e1 * cy - e2 * by) / det
        per_y[k] = (e2 * bx - e1 * cx) / det
        origin[k] = corners[f, 0, k] - ax * per_x[k] - ay * per_y[k]
    return origin, per_x, per_y, True


@njit(cache=True, parallel=True)
def count(owner: I32, seen: U8, flat: F32) -> I64:
    """(F, 4) texels per face: all, seen by a photo (255), coloured from points (128), filled (64)."""
    height, width = owner.shape
    out = np.zeros((len(flat), 4), np.int64)
    for f in prange(len(flat)):
        x0, y0, x1, y1 = box(flat, f, width, height)
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                if owner[y, x] == f:
                    out[f, 0] += 1
                    s = seen[y, x]
                    out[f, 1] += s == 255
                    out[f, 2] += s == 128
                    out[f, 3] += s == 64
    return out
