"""Alpha blending of splats within tiles, nearest first, and its gradient.

Loops run over whole rows of a tile, with unsigned indices and constants of 32 bits, so that LLVM vectorizes them.

Kernels of this package use constants of their own module only, and get others as arguments: numba compiles a cached
kernel again if its own file changes, but not if another does.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

WIDTH, HEIGHT = 8, 32
"""Size of a tile in pixels: narrow, as only the rows that a splat overlaps are drawn, but over the whole width."""
PIXELS = WIDTH * HEIGHT
RED, GREEN, BLUE, DEVIATION, TRANSMITTANCE, MEDIAN = range(6)
"""Channels of a blended tile (6, 256): colours and deviation of the inverse depth from the known one, times alpha; what
is left of the background; inverse depth at which `HALF` is left, 1/metres, 0 where more is left."""
CHANNELS = 6
MAX_ALPHA = np.float32(0.99)
MIN_ALPHA = np.float32(1 / 255)
"""Splats are drawn where their alpha is at least this."""
ZERO, ONE, TWO = np.float32(0), np.float32(1), np.float32(2)
"""In numba the product of an integer and a float of 32 bits has 64 bits, which halves the speed of the loops."""
HALF = np.float32(0.5)
MAX_DEVIATION = np.float32(0.2)
"""Greatest deviation of an inverse depth, relative to the known one: what is farther away is as wrong."""
LOWEST, HIGHEST = np.float32(0.5), np.float32(1.5)
"""Least and greatest inverse depth within a splat, relative to that of its centre."""
OPAQUE = np.float32(0.003)
"""Greatest transmittance at which nothing behind matters."""
CHECKED_EVERY = 8
"""Splats between tests whether a tile is opaque."""
X = (np.arange(PIXELS) % WIDTH).astype(np.float32)
Y = (np.arange(PIXELS) // WIDTH).astype(np.float32)
# exp(-q / 2) = exp(-q / 32)^16, the latter as its minimax polynomial where it matters (q < 11.1): within 1e-4
E0, E1, E2, E3 = np.float32(0.99999529), np.float32(-0.99959058), np.float32(0.49423736), np.float32(-0.13991767)
FARTHEST = np.float32(32)
"""Squared distance in standard deviations at which the polynomial ends, at 1e-8."""
FASTMATH = {"reassoc", "contract", "nsz", "arcp", "afn"}
"""Without "nnan" and "ninf", with which the limits of values that aren't finite would be undefined."""


@njit(cache=True, parallel=True, fastmath=FASTMATH, error_model="numpy")
def blend(  # type: ignore[no-untyped-def]
    parameters, projected, columns, start, splat, known, width, height, tiles, last
):
    """Blend the splats of each tile.

    Args:
        parameters: (N, 14); projected: (N, 11).
        columns, start, splat: of the tiles' `Assignment`.
        known: (T, 256) known depths, metres; where it is 0, the channel `DEVIATION` means nothing.
        width, height: of the image in pixels; a tile's pixels outside are opaque from the start.
        tiles: (T, 6, 256), written.
        last: (T,) number of the splats that were blended, written.
    """
    for tile in prange(len(tiles)):
        image, expected = tiles[tile], known[tile]
        left, top = np.float32(tile % columns * WIDTH), np.float32(tile // columns * HEIGHT)
        image[:] = 0
        for p in range(np.uint64(PIXELS)):
            inside = (X[p] + left < np.float32(width)) & (Y[p] + top < np.float32(height))
            image[TRANSMITTANCE, p] = ONE if inside else ZERO
        number = 0
        for entry in range(start[tile], start[tile + 1]):
            i = splat[entry]
            number += 1
            u, v = projected[i, 0] - left, projected[i, 1] - top
            a, b, c = projected[i, 2], TWO * projected[i, 3], projected[i, 4]
            opacity, slope_x, slope_y = projected[i, 5], projected[i, 9], projected[i, 10]
            inverse = ONE / projected[i, 8]
            lowest, highest = LOWEST * inverse, HIGHEST * inverse
            red, green, blue = parameters[i, 11], parameters[i, 12], parameters[i, 13]
            first = max(int(v - projected[i, 7]), 0)
            end = min(int(v + projected[i, 7]) + 2, HEIGHT)
            for p in range(np.uint64(first * WIDTH), np.uint64(end * WIDTH)):
                dx, dy = X[p] - u, Y[p] - v
                square = max(a * dx * dx + b * dx * dy + c * dy * dy, ZERO)  # rounding can make it negative
                q = min(square, FARTHEST) * np.float32(1 / 32)
                k = E0 + q * (E1 + q * (E2 + q * E3))
                k = k * k
                k = k * k
                k = k * k
                k = k * k
                alpha = min(opacity * k, MAX_ALPHA)
                alpha = alpha if alpha >= MIN_ALPHA else ZERO
                before = image[TRANSMITTANCE, p]
                weight = alpha * before
                after = before - weight
                image[RED, p] += weight * red
                image[GREEN, p] += weight * green
                image[BLUE, p] += weight * blue
                here = min(max(inverse + slope_x * dx + slope_y * dy, lowest), highest)
                image[DEVIATION, p] += weight * min(abs(here * expected[p] - ONE), MAX_DEVIATION)
                image[MEDIAN, p] += here if (before > HALF) & (after <= HALF) else ZERO  # a masked store is slow
                image[TRANSMITTANCE, p] = after
            if number % CHECKED_EVERY == 0:
                most = np.float32(0)
                for p in range(np.uint64(PIXELS)):
                    most = max(most, image[TRANSMITTANCE, p])
                if most < OPAQUE:
                    break
        last[tile] = number


@njit(cache=True, parallel=True, fastmath=FASTMATH, error_model="numpy")
def blend_gradients(  # type: ignore[no-untyped-def]
    parameters, projected, columns, start, splat, slot, known, tiles, last, background, gradient, entries
):
    """Gradients of the entries (`projection.GRADIENT`) by those of the image.

    Args:
        parameters, projected, columns, start, splat, slot, known: as in `blend`. The slope of a splat's inverse
            depth counts as constant.
        tiles, last: results of `blend`.
        background: (T, 3, 256) colour behind the splats.
        gradient: (T, 5, 256) derivatives of the loss by colour (with the background), the channel `DEVIATION`, which
            must be 0 where no depth is known, and alpha.
        entries: (E, 10), written; those that weren't blended are 0.
    """
    for tile in prange(len(tiles)):
        if start[tile] == start[tile + 1]:
            continue
        image, g, behind, expected = tiles[tile], gradient[tile], background[tile], known[tile]
        left, top = np.float32(tile % columns * WIDTH), np.float32(tile // columns * HEIGHT)
        T, rest = np.ones(PIXELS, np.float32), np.empty(PIXELS, np.float32)
        for p in range(np.uint64(PIXELS)):
            through = image[TRANSMITTANCE, p]
            rest[p] = (
                g[RED, p] * (image[RED, p] + through * behind[RED, p])
                + g[GREEN, p] * (image[GREEN, p] + through * behind[GREEN, p])
                + g[BLUE, p] * (image[BLUE, p] + through * behind[BLUE, p])
                + g[DEVIATION, p] * image[DEVIATION, p]
                + g[TRANSMITTANCE, p] * (ONE - through)
            )
        for entry in range(start[tile], start[tile] + last[tile]):
            i = splat[entry]
            u, v = projected[i, 0] - left, projected[i, 1] - top
            a, b, c = projected[i, 2], projected[i, 3], projected[i, 4]
            opacity, slope_x, slope_y = projected[i, 5], projected[i, 9], projected[i, 10]
            inverse = ONE / projected[i, 8]
            lowest, highest = LOWEST * inverse, HIGHEST * inverse
            red, green, blue = parameters[i, 11], parameters[i, 12], parameters[i, 13]
            first = max(int(v - projected[i, 7]), 0)
            end = min(int(v + projected[i, 7]) + 2, HEIGHT)
            s0, s1, s2, s3, s4 = np.float32(0), np.float32(0), np.float32(0), np.float32(0), np.float32(0)
            s5, s6, s7, s8, s9 = np.float32(0), np.float32(0), np.float32(0), np.float32(0), np.float32(0)
            for p in range(np.uint64(first * WIDTH), np.uint64(end * WIDTH)):
                dx, dy = X[p] - u, Y[p] - v
                square = max(a * dx * dx + TWO * b * dx * dy + c * dy * dy, ZERO)
                q = min(square, FARTHEST) * np.float32(1 / 32)
                k = E0 + q * (E1 + q * (E2 + q * E3))
                k = k * k
                k = k * k
                k = k * k
                k = k * k
                alpha = min(opacity * k, MAX_ALPHA)
                alpha = alpha if alpha >= MIN_ALPHA else np.float32(0)
                weight = alpha * T[p]
                here = inverse + slope_x * dx + slope_y * dy
                deviation = min(max(here, lowest), highest) * expected[p] - ONE
                value = g[RED, p] * red + g[GREEN, p] * green + g[BLUE, p] * blue
                value += g[DEVIATION, p] * min(abs(deviation), MAX_DEVIATION) + g[TRANSMITTANCE, p]
                rest[p] -= weight * value
                by_alpha = T[p] * value - rest[p] / (ONE - alpha)
                by_alpha = by_alpha if MIN_ALPHA <= opacity * k < MAX_ALPHA else np.float32(0)
                T[p] -= weight
                by_square = np.float32(-0.5) * opacity * k * by_alpha
                s0 += weight * g[RED, p]
                s1 += weight * g[GREEN, p]
                s2 += weight * g[BLUE, p]
                by_inverse = expected[p] if deviation > 0 else -expected[p]
                inside = (abs(deviation) < MAX_DEVIATION) & (here > lowest) & (here < highest)
                s3 += weight * g[DEVIATION, p] * (by_inverse if inside else np.float32(0))
                s4 += by_alpha * k
                s5 += by_square * (a * dx + b * dy)
                s6 += by_square * (b * dx + c * dy)
                s7 += by_square * dx * dx
                s8 += by_square * dx * dy
                s9 += by_square * dy * dy
            e = entries[slot[entry]]
            e[0], e[1], e[2], e[3], e[4] = s0, s1, s2, s3, s4
            e[5], e[6], e[7], e[8], e[9] = -2 * s5, -2 * s6, s7, 2 * s8, s9
