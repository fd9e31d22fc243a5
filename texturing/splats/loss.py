"""Photometric loss of training, and its derivative: Charbonnier of the colours, and SSIM of the luminance.

Three kernels pass over the rows of the image: differences and luminances; SSIM and its derivatives by the windows'
moments; the derivative by the colours. Constants that an ablation changes are their arguments.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit, prange

from scan2sim.pipeline.core.types import F32, U8, Bools
from scan2sim.texturing.splats.exposure import CURVE_OFFSET, Response

CHARBONNIER = 0.04
"""Difference (sRGB 0 to 1) around which the penalty changes from quadratic to linear."""
SSIM_SHARE = 0.2
RED, GREEN, BLUE = np.float32(0.299), np.float32(0.587), np.float32(0.114)
"""Shares of the luminance."""
WINDOW_SIGMA_PX, BESIDE = 1.5, 5
"""Standard deviation of the windows of SSIM, and their pixels to each side of the middle."""
_BELL = np.exp(-0.5 * (np.arange(-BESIDE, BESIDE + 1) / WINDOW_SIGMA_PX) ** 2)
WINDOW = (_BELL / _BELL.sum()).astype(np.float32)
C1, C2 = np.float32(0.01**2), np.float32(0.03**2)
CLIPPED_LOW, CLIPPED_HIGH = np.uint8(2), np.uint8(250)
"""Grey levels of a photo from which it is clipped: a rendering that is darker, or brighter, is as good."""
LEVEL = np.float32(1 / 255)
ONE, TWO, ZERO = np.float32(1), np.float32(2), np.float32(0)


class Loss(NamedTuple):
    """Loss of a rendering against a photo.

    Attributes:
        value: per pixel that counts.
        gradient: (H, W, 3) derivative of `value` by the rendering, times the number of pixels that count.
        psnr: dB, of the pixels that count; NaN if there are none.
    """

    value: float
    gradient: F32
    psnr: float


def photometric(rendered: F32, photo: U8, used: Bools, response: Response) -> Loss:
    """Compare a rendering with a photo.

    Args:
        rendered: (H, W, 3) rendering in colours of the world, sRGB, may exceed 0 to 1.
        photo: (H, W, 3) grey levels.
        used: (H, W) pixels that count. Others have no effect on the windows of SSIM either.
        response: how the photo shows colours of the world.
    """
    height, width = used.shape
    difference = np.empty((height, width, 3), np.float32)
    x, y = np.empty((2, height, width), np.float32)
    moments = np.empty((3, height, width), np.float32)
    sums = np.zeros((height, 3))
    _differences(rendered, photo, used, *response, CURVE_OFFSET, np.float32(CHARBONNIER**2), difference, x, y, sums)
    _similarity(x, y, used, _window_factors(height), _window_factors(width), moments, sums)
    _gradient(difference, x, y, used, response.gain, response.vignetting, moments, np.float32(SSIM_SHARE),
              np.float32(CHARBONNIER**2))  # fmt: skip
    squared, charbonnier, similarity = sums.sum(axis=0).tolist()
    count = int(used.sum())
    if not count:
        return Loss(0.0, difference, math.nan)
    value = (1 - SSIM_SHARE) * (charbonnier / (3 * count) - CHARBONNIER) + SSIM_SHARE / 2 * (1 - similarity / count)
    return Loss(value, difference, -10 * math.log10(max(squared / (3 * count), 1e-10)))


def _window_factors(length: int) -> F32:
    """(N,) inverse of the weight of `WINDOW` that is inside an image of N pixels, around each of them."""
    up_to = np.concatenate([[0], np.cumsum(WINDOW, dtype=np.float64)])
    at = np.arange(length)
    first, end = np.maximum(BESIDE - at, 0), np.minimum(BESIDE + length - at, len(WINDOW))
    return (1 / (up_to[end] - up_to[first])).astype(np.float32)


@njit(cache=True, parallel=True, fastmath=True, error_model="numpy")
def _differences(  # type: ignore[no-untyped-def]
    rendered, photo, used, gain, offset, vignetting, curve_offset, charbonnier, difference, x, y, sums
):
    """Rendering as the photo shows it less the photo, 0 where nothing counts; luminances of both.

    Args:
        rendered, photo, used, gain, offset, vignetting: as in `photometric`.
        curve_offset: `CURVE_OFFSET`.
        charbonnier: `CHARBONNIER` squared.
        difference: (H, W, 3), written.
        x, y: (H, W) luminances of rendering and photo, written.
        sums: (H, 3), of rows: squared differences and their penalties are added to columns 0 and 1.
    """
    height, width = used.shape
    same = vignetting.shape[0] == 1
    for row in prange(height):
        squared, penalty = 0.0, 0.0
        for column in range(width):
            share = vignetting[0, 0] if same else vignetting[row, column]
            for k in range(3):
                level = photo[row, column, k]
                apart = share * (gain[k] * rendered[row, column, k] + offset[k]) - curve_offset - LEVEL * level
                as_good = (level >= CLIPPED_HIGH and apart > 0) or (level <= CLIPPED_LOW and apart < 0)
                if as_good or not used[row, column]:
                    apart = ZERO
                difference[row, column, k] = apart
                if used[row, column]:
                    squared += apart * apart
                    penalty += np.sqrt(apart * apart + charbonnier)
            own = RED * photo[row, column, 0] + GREEN * photo[row, column, 1] + BLUE * photo[row, column, 2]
            apart = RED * difference[row, column, 0] + GREEN * difference[row, column, 1]
            y[row, column] = LEVEL * own
            x[row, column] = LEVEL * own + apart + BLUE * difference[row, column, 2]
        sums[row, 0], sums[row, 1] = squared, penalty


@njit(cache=True, parallel=True, fastmath=True, error_model="numpy")
def _similarity(x, y, used, down, across, moments, sums):  # type: ignore[no-untyped-def]
    """SSIM (Wang et al. 2004) of images (H, W) 0 to 1; at their borders, of the part of the window that is inside.

    Args:
        x, y: (H, W) the images.
        used: (H, W) pixels whose windows count.
        down, across: (H,) and (W,) factors of the windows' sums that make them means (`_window_factors`).
        moments: (3, H, W) derivatives of the sum of the SSIM by the windows' sums of x, x * x, x * y; written.
        sums: (H, 3), SSIM of rows is added to column 2.
    """
    height, width = x.shape
    for row in prange(height):
        columns = np.zeros((5, width + 2 * BESIDE), np.float32)
        for k in range(len(WINDOW)):
            at = row + k - BESIDE
            if 0 <= at < height:
                _add_moments(WINDOW[k], x[at], y[at], columns)
        mean = np.zeros((5, width), np.float32)
        for m in range(5):
            for k in range(len(WINDOW)):
                _add(WINDOW[k], columns[m, k : k + width], mean[m])
        total = 0.0
        for column in range(width):
            counts = ONE if used[row, column] else ZERO
            factor = down[row] * across[column]
            mx, my = factor * mean[0, column], factor * mean[1, column]
            sxx, syy = factor * mean[2, column] - mx * mx, factor * mean[3, column] - my * my
            sxy = factor * mean[4, column] - mx * my
            a1, a2 = TWO * mx * my + C1, TWO * sxy + C2
            b1, b2 = mx * mx + my * my + C1, sxx + syy + C2
            similarity = counts * a1 * a2 / (b1 * b2)
            by_xx, by_xy = -similarity / b2, counts * TWO * a1 / (b1 * b2)
            by_x = counts * TWO * my * a2 / (b1 * b2) - TWO * mx * similarity / b1 - TWO * mx * by_xx - my * by_xy
            moments[0, row, column], moments[1, row, column] = factor * by_x, factor * by_xx
            moments[2, row, column] = factor * by_xy
            total += similarity
        sums[row, 2] = total


@njit(cache=True, parallel=True, fastmath=True, error_model="numpy")
def _gradient(  # type: ignore[no-untyped-def]
    difference, x, y, used, gain, vignetting, moments, ssim_share, charbonnier
):
    """Derivative of the loss by the rendering, written over the differences; see `_differences` and `_similarity`."""
    height, width = x.shape
    same = vignetting.shape[0] == 1
    each = (ONE - ssim_share) / np.float32(3)
    for row in prange(height):
        columns = np.zeros((3, width + 2 * BESIDE), np.float32)
        mean = np.zeros((3, width), np.float32)
        for m in range(3):
            for k in range(len(WINDOW)):
                at = row + k - BESIDE
                if 0 <= at < height:
                    _add(WINDOW[k], moments[m, at], columns[m, BESIDE : BESIDE + width])
            for k in range(len(WINDOW)):
                _add(WINDOW[k], columns[m, k : k + width], mean[m])
        for column in range(width):
            share = vignetting[0, 0] if same else vignetting[row, column]
            by_x = mean[0, column] + TWO * x[row, column] * mean[1, column] + y[row, column] * mean[2, column]
            by_x = -ssim_share / TWO * by_x
            for k in range(3):
                apart = difference[row, column, k]
                if apart == ZERO:  # masked, clipped, or as it should be
                    continue
                luminance = RED if k == 0 else GREEN if k == 1 else BLUE
                by_colour = each * apart / np.sqrt(apart * apart + charbonnier) + luminance * by_x
                difference[row, column, k] = share * gain[k] * by_colour


@njit(cache=True, fastmath=True, inline="always")
def _add(weight, values, total):  # type: ignore[no-untyped-def]
    """Add weighted values (N,) to a total (N,)."""
    for i in range(np.uint64(len(total))):
        total[i] += weight * values[i]


@njit(cache=True, fastmath=True, inline="always")
def _add_moments(weight, x, y, total):  # type: ignore[no-untyped-def]
    """Add weighted x, y, x * x, y * y and x * y of values (N,) to totals (5, N + 2 * `BESIDE`)."""
    end = BESIDE + len(x)
    tx, ty, txy = total[0, BESIDE:end], total[1, BESIDE:end], total[4, BESIDE:end]
    txx, tyy = total[2, BESIDE:end], total[3, BESIDE:end]
    for i in range(np.uint64(len(x))):
        a, b = x[i], y[i]
        tx[i] += weight * a
        ty[i] += weight * b
        txx[i] += weight * a * a
        tyy[i] += weight * b * b
        txy[i] += weight * a * b
