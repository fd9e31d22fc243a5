"""How a picture is read at a pixel of the photo that it belongs to, written once for all kernels.

Pictures (the photo, halvings of it, masks, classes, range images, warps) may be of any size: they cover the photo.
A photo is told by its camera's parameters `p` (`cameras.parameters`); `wrap` says that its sides meet, as a panorama's
do. Import late: it loads numba.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from scan2sim.pipeline.core.types import F32, F64, I64, U8

Taps = tuple[int, int, int, int, float, float, float, float]
"""Columns, rows, and weights of a bilinear lookup: see `taps`."""


@njit(cache=True, inline="always")
def rescaled(p: F64, u: float, v: float, picture: npt.NDArray[Any]) -> tuple[float, float]:
    """(x, y): the pixel of a picture (H, W, ...) that shows what the photo's pixel (u, v) shows."""
    return (u + 0.5) * (picture.shape[1] / p[12]) - 0.5, (v + 0.5) * (picture.shape[0] / p[13]) - 0.5


@njit(cache=True, inline="always")
def halving(wide: float, count: int) -> int:
    """Which of `count` halvings of a photo to read where what is painted is `wide` of its pixels wide: no finer one."""
    level = 0
    while level + 1 < count and wide >= 1.6:
        wide *= 0.5
        level += 1
    return level


@njit(cache=True, inline="always")
def nearest(p: F64, u: float, v: float, picture: npt.NDArray[Any]) -> tuple[int, int]:
    """(row, column) of the pixel of a picture (H, W, ...) that a place (u, v) within the photo is in."""
    row, column = int((v + 0.5) * (picture.shape[0] / p[13])), int((u + 0.5) * (picture.shape[1] / p[12]))
    return min(max(row, 0), picture.shape[0] - 1), min(max(column, 0), picture.shape[1] - 1)


@njit(cache=True, inline="always")
def allows(mask: U8, p: F64, u: float, v: float) -> bool:
    """Whether a mask (H, W), 0 where the photo must not be used, lets it be used at (u, v); (0, 0) always does."""
    if mask.shape[0] == 0:
        return True
    row, column = nearest(p, u, v, mask)
    return mask[row, column] != 0


@njit(cache=True, inline="always")
def taps(picture: npt.NDArray[Any], x: float, y: float, wrap: bool) -> Taps:
    """(a, b, c, d, w_ca, w_cb, w_da, w_db): columns, rows, weights of a bilinear lookup; outside, borders go on."""
    height, width = picture.shape[0], picture.shape[1]
    x0, y0 = math.floor(x), math.floor(y)
    s, t = x - x0, y - y0
    a, b = int(x0), int(x0) + 1
    if wrap:
        a, b = a % width, b % width
    else:
        a, b = min(max(a, 0), width - 1), min(max(b, 0), width - 1)
    c, d = min(max(int(y0), 0), height - 1), min(max(int(y0) + 1, 0), height - 1)
    return a, b, c, d, (1 - s) * (1 - t), s * (1 - t), (1 - s) * t, s * t


@njit(cache=True, inline="always")
def mixed(picture: npt.NDArray[Any], k: int, at: Taps) -> float:
    """Channel k of a picture (H, W, C) at `taps`."""
    a, b, c, d, w_ca, w_cb, w_da, w_db = at
    return picture[c, a, k] * w_ca + picture[c, b, k] * w_cb + picture[d, a, k] * w_da + picture[d, b, k] * w_db


@njit(cache=True, inline="always")
def bilinear(picture: npt.NDArray[Any], x: float, y: float, wrap: bool) -> tuple[float, float, float]:
    """(r, g, b) of a picture (H, W, 3) at its pixel (x, y)."""
    at = taps(picture, x, y, wrap)
    return mixed(picture, 0, at), mixed(picture, 1, at), mixed(picture, 2, at)


@njit(cache=True, inline="always")
def of_uv(page: npt.NDArray[Any], u: Any, v: Any) -> tuple[Any, Any]:
    """(x, y): the pixel of a page (H, W, ...) at texture coordinates (float32), (0, 0) its lower left corner."""
    half = np.float32(0.5)
    return u * np.float32(page.shape[1]) - half, (np.float32(1) - v) * np.float32(page.shape[0]) - half


@njit(cache=True, parallel=True)
def page_colours(page: U8, uv: F32) -> F32:
    """(N, 3) float32 bilinear colours of a page (H, W, 3) at texture coordinates (N, 2) float32."""
    rgb = np.empty((len(uv), 3), np.float32)
    for i in prange(len(uv)):
        x, y = of_uv(page, uv[i, 0], uv[i, 1])
        rgb[i, 0], rgb[i, 1], rgb[i, 2] = bilinear(page, x, y, False)
    return rgb


@njit(cache=True, parallel=True)
def page_taps(page: U8, uv: F32) -> tuple[I64, F32]:
    """What `page_colours` reads: (N, 4) int64 texels, counted along the rows, and (N, 4) float32 weights."""
    texel, weight = np.empty((len(uv), 4), np.int64), np.empty((len(uv), 4), np.float32)
    for i in prange(len(uv)):
        x, y = of_uv(page, uv[i, 0], uv[i, 1])
        a, b, c, d, w_ca, w_cb, w_da, w_db = taps(page, x, y, False)
        upper, lower = c * page.shape[1], d * page.shape[1]
        texel[i, 0], texel[i, 1], texel[i, 2], texel[i, 3] = upper + a, upper + b, lower + a, lower + b
        weight[i, 0], weight[i, 1], weight[i, 2], weight[i, 3] = w_ca, w_cb, w_da, w_db
    return texel, weight


@njit(cache=True, inline="always")
def read(picture: npt.NDArray[Any], p: F64, u: float, v: float, wrap: bool) -> tuple[float, float, float]:
    """(r, g, b) of a picture (H, W, 3) of a photo, where the photo's pixel (u, v) is."""
    x, y = rescaled(p, u, v, picture)
    return bilinear(picture, x, y, wrap)


@njit(cache=True)
def bicubic(picture: npt.NDArray[Any], x: float, y: float, wrap: bool) -> tuple[float, float, float]:
    """The same, bicubic: keeps what bilinear interpolation blurs (Catmull and Rom)."""
    height, width = picture.shape[0], picture.shape[1]
    x0, y0 = math.floor(x), math.floor(y)
    across, down = _cubic(x - x0), _cubic(y - y0)
    r = g = b = 0.0
    for j in range(4):
        row = min(max(int(y0) + j - 1, 0), height - 1)
        for i in range(4):
            column = int(x0) + i - 1
            column = column % width if wrap else min(max(column, 0), width - 1)
            w = across[i] * down[j]
            r += w * picture[row, column, 0]
            g += w * picture[row, column, 1]
            b += w * picture[row, column, 2]
    return r, g, b


@njit(cache=True, inline="always")
def _cubic(f: float) -> tuple[float, float, float, float]:
    """Weights of four neighbours at fraction f between the middle ones."""
    f2, f3 = f * f, f * f * f
    return (
        -0.5 * f3 + f2 - 0.5 * f,
        1.5 * f3 - 2.5 * f2 + 1,
        -1.5 * f3 + 2 * f2 + 0.5 * f,
        0.5 * f3 - 0.5 * f2,
    )
