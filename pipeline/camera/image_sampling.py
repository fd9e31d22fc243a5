"""Image sampling: nearest, bilinear and bicubic lookup of images at a pixel of their photo, shared by all kernels.

Images (the photo, its mip levels, masks, classes, range images, warps) may have any size and cover the whole photo. The
size of the photo is in its camera's parameters `p` (`models.parameters`); `wrap`: left and right borders are adjacent,
as in a panorama. Import lazily: it loads numba.
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
def rescaled(p: F64, u: float, v: float, image: npt.NDArray[Any]) -> tuple[float, float]:
    """(x, y): pixel of an image (H, W, ...) at the position of the photo's pixel (u, v)."""
    return (u + 0.5) * (image.shape[1] / p[12]) - 0.5, (v + 0.5) * (image.shape[0] / p[13]) - 0.5


@njit(cache=True, inline="always")
def mip_level(footprint: float, count: int) -> int:
    """Mip level (0 to `count` - 1) of a photo to sample for a texel that is `footprint` pixels wide in the photo."""
    level = 0
    while level + 1 < count and footprint >= 1.6:
        footprint *= 0.5
        level += 1
    return level


@njit(cache=True, inline="always")
def nearest(p: F64, u: float, v: float, image: npt.NDArray[Any]) -> tuple[int, int]:
    """(row, column) of the pixel of an image (H, W, ...) that contains the photo's (u, v)."""
    row, column = int((v + 0.5) * (image.shape[0] / p[13])), int((u + 0.5) * (image.shape[1] / p[12]))
    return min(max(row, 0), image.shape[0] - 1), min(max(column, 0), image.shape[1] - 1)


@njit(cache=True, inline="always")
def allows(mask: U8, p: F64, u: float, v: float) -> bool:
    """Whether a mask (H, W), 0 where the photo must not be used, allows (u, v); a mask of shape (0, 0) allows all."""
    if mask.shape[0] == 0:
        return True
    row, column = nearest(p, u, v, mask)
    return mask[row, column] != 0


@njit(cache=True, inline="always")
def taps(image: npt.NDArray[Any], x: float, y: float, wrap: bool) -> Taps:
    """(a, b, c, d, w_ca, w_cb, w_da, w_db): columns, rows, weights of a bilinear lookup, clamped to the border."""
    height, width = image.shape[0], image.shape[1]
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
def mixed(image: npt.NDArray[Any], k: int, at: Taps) -> float:
    """Channel k of an image (H, W, C), interpolated at `taps`."""
    a, b, c, d, w_ca, w_cb, w_da, w_db = at
    return image[c, a, k] * w_ca + image[c, b, k] * w_cb + image[d, a, k] * w_da + image[d, b, k] * w_db


@njit(cache=True, inline="always")
def bilinear(image: npt.NDArray[Any], x: float, y: float, wrap: bool) -> tuple[float, float, float]:
    """(r, g, b) of an image (H, W, 3) at its pixel (x, y), bilinear."""
    at = taps(image, x, y, wrap)
    return mixed(image, 0, at), mixed(image, 1, at), mixed(image, 2, at)


@njit(cache=True, inline="always")
def uv_to_pixel(page: npt.NDArray[Any], u: Any, v: Any) -> tuple[Any, Any]:
    """(x, y): pixel of a page (H, W, ...) at texture coordinates (float32); (0, 0) is the lower left corner."""
    half = np.float32(0.5)
    return u * np.float32(page.shape[1]) - half, (np.float32(1) - v) * np.float32(page.shape[0]) - half


@njit(cache=True, parallel=True)
def page_colours(page: U8, uv: F32) -> F32:
    """(N, 3) float32 bilinear colours of a page (H, W, 3) at texture coordinates (N, 2) float32."""
    rgb = np.empty((len(uv), 3), np.float32)
    for i in prange(len(uv)):
        x, y = uv_to_pixel(page, uv[i, 0], uv[i, 1])
        rgb[i, 0], rgb[i, 1], rgb[i, 2] = bilinear(page, x, y, False)
    return rgb


@njit(cache=True, parallel=True)
def page_taps(page: U8, uv: F32) -> tuple[I64, F32]:
    """Texels (N, 4) (int64, row-major index) that `page_colours` reads, and their weights (N, 4) float32."""
    texel, weight = np.empty((len(uv), 4), np.int64), np.empty((len(uv), 4), np.float32)
    for i in prange(len(uv)):
        x, y = uv_to_pixel(page, uv[i, 0], uv[i, 1])
        a, b, c, d, w_ca, w_cb, w_da, w_db = taps(page, x, y, False)
        upper, lower = c * page.shape[1], d * page.shape[1]
        texel[i, 0], texel[i, 1], texel[i, 2], texel[i, 3] = upper + a, upper + b, lower + a, lower + b
        weight[i, 0], weight[i, 1], weight[i, 2], weight[i, 3] = w_ca, w_cb, w_da, w_db
    return texel, weight


@njit(cache=True, inline="always")
def read(image: npt.NDArray[Any], p: F64, u: float, v: float, wrap: bool) -> tuple[float, float, float]:
    """(r, g, b) of an image (H, W, 3) at the photo's pixel (u, v), bilinear."""
    x, y = rescaled(p, u, v, image)
    return bilinear(image, x, y, wrap)


@njit(cache=True)
def bicubic(image: npt.NDArray[Any], x: float, y: float, wrap: bool) -> tuple[float, float, float]:
    """(r, g, b) of an image (H, W, 3) at its pixel (x, y), bicubic (Catmull and Rom): sharper than bilinear."""
    height, width = image.shape[0], image.shape[1]
    x0, y0 = math.floor(x), math.floor(y)
    across, down = _cubic(x - x0), _cubic(y - y0)
    r = g = b = 0.0
    for j in range(4):
        row = min(max(int(y0) + j - 1, 0), height - 1)
        for i in range(4):
            column = int(x0) + i - 1
            column = column % width if wrap else min(max(column, 0), width - 1)
            w = across[i] * down[j]
            r += w * image[row, column, 0]
            g += w * image[row, column, 1]
            b += w * image[row, column, 2]
    return r, g, b


@njit(cache=True, inline="always")
def _cubic(f: float) -> tuple[float, float, float, float]:
    """Weights of four neighbours at fraction f between the two in the middle."""
    f2, f3 = f * f, f * f * f
    return (
        -0.5 * f3 + f2 - 0.5 * f,
        1.5 * f3 - 2.5 * f2 + 1,
        -1.5 * f3 + 2 * f2 + 0.5 * f,
        0.5 * f3 - 0.5 * f2,
    )
