"""Alpha blending of splats within tiles, nearest first, and its gradient.

Loops run over whole rows of a tile, with unsigned indices and constants of 32 bits, so that LLVM vectorizes them.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from scan2sim.texturing.splats import projection
from scan2sim.texturing.splats.tiles import PIXELS, SIZE

RED, GREEN, BLUE, DEPTH, TRANSMITTANCE = range(5)
"""Channels of a blended tile (5, 256): colours and depth (or its deviation) times alpha, and what is left of the
background."""
MAX_ALPHA = np.float32(0.99)
MIN_ALPHA = np.float32(projection.MIN_ALPHA)
TWO, NEAREST = np.float32(2), np.float32(projection.NEAR_M)
"""In numba the product of an integer and a float of 32 bits has 64 bits, which halves the speed of the loops."""
MAX_DEVIATION = np.float32(0.2)
"""Greatest deviation of a depth, relative to the known one: what is farther away is as wrong."""
OPAQUE = np.float32(0.003)
"""Greatest transmittance at which nothing behind matters."""
CHECKED_EVERY = 8
"""Splats between tests whether a tile is opaque."""
X = (np.arange(PIXELS) % SIZE).astype(np.float32)
Y = (np.arange(PIXELS) // SIZE).astype(np.float32)
# exp(-q / 2) = exp(-q / 32)^16, the latter as its minimax polynomial where it matters (q < 11.1): within 1e-4
E0, E1, E2, E3 = np.float32(0.99999529), np.float32(-0.99959058), np.float32(0.49423736), np.float32(-0.13991767)
FARTHEST = np.float32(32)
"""Squared distance in standard deviations at which the polynomial ends, at 1e-8."""


@njit(cache=True, parallel=True, fastmath=True, error_model="numpy")
def blend(parameters, projected, columns, start, splat, known, tiles, last):  # type: ignore[no-untyped-def]
    """Blend the splats of each tile.

    Args:
        parameters: (N, 14); projected: (N, 11).
        columns, start, splat: of the tiles' `Assignment`.
        known: (T, 256) known depths, metres, 0 where there is none; the channel `DEPTH` has deviations from these.
        tiles: (T, 5, 256), written.
        last: (T,) number of the splats that were blended, written.
    """
    for tile in prange(len(tiles)):
        image, expected = tiles[tile], known[tile]
        left, top = np.float32(tile % columns * SIZE), np.float32(tile // columns * SIZE)
        image[:TRANSMITTANCE] = 0
        image[TRANSMITTANCE] = 1
        number = 0
        for entry in range(start[tile], start[tile + 1]):
            i = splat[entry]
            number += 1
            u, v = projected[i, 0] - left, projected[i, 1] - top
            a, b, c = projected[i, 2], TWO * projected[i, 3], projected[i, 4]
            opacity, z, slope_x, slope_y = projected[i, 5], projected[i, 8], projected[i, 9], projected[i, 10]
            red, green, blue = parameters[i, 11], parameters[i, 12], parameters[i, 13]
            first = max(int(v - projected[i, 7]), 0)
            end = min(int(v + projected[i, 7]) + 2, SIZE)
            for p in range(np.uint64(first * SIZE), np.uint64(end * SIZE)):
                dx, dy = X[p] - u, Y[p] - v
                q = min(a * dx * dx + b * dx * dy + c * dy * dy, FARTHEST) * np.float32(1 / 32)
                k = E0 + q * (E1 + q * (E2 + q * E3))
                k = k * k
                k = k * k
                k = k * k
                k = k * k
                alpha = min(opacity * k, MAX_ALPHA)
                alpha = alpha if alpha >= MIN_ALPHA else np.float32(0)
                weight = alpha * image[TRANSMITTANCE, p]
                image[RED, p] += weight * red
                image[GREEN, p] += weight * green
                image[BLUE, p] += weight * blue
                depth = z + slope_x * dx + slope_y * dy
                deviation = min(abs(depth - expected[p]) / max(expected[p], NEAREST), MAX_DEVIATION)
                image[DEPTH, p] += weight * (deviation if expected[p] > 0 else depth)
                image[TRANSMITTANCE, p] -= weight
            if number % CHECKED_EVERY == 0:
                most = np.float32(0)
                for p in range(np.uint64(PIXELS)):
                    most = max(most, image[TRANSMITTANCE, p])
                if most < OPAQUE:
                    break
        last[tile] = number


@njit(cache=True, parallel=True, fastmath=True, error_model="numpy")
def blend_gradients(  # type: ignore[no-untyped-def]
    parameters, projected, columns, start, splat, slot, known, tiles, last, background, gradient, entries
):
    """Gradients of the entries (`projection.GRADIENT`) by those of the image.

    Args:
        parameters, projected, columns, start, splat, slot, known: as in `blend`. The slope of a splat's depth counts as
            constant.
        tiles, last: results of `blend`.
        background: (T, 3, 256) colour behind the splats.
        gradient: (T, 5, 256) derivatives of the loss by colour (with the background), the channel `DEPTH`, and alpha.
        entries: (E, 10), written; those that weren't blended are 0.
    """
    for tile in prange(len(tiles)):
        if start[tile] == start[tile + 1]:
            continue
        image, g, behind, expected = tiles[tile], gradient[tile], background[tile], known[tile]
        left, top = np.float32(tile % columns * SIZE), np.float32(tile // columns * SIZE)
        T, rest = np.ones(PIXELS, np.float32), np.empty(PIXELS, np.float32)
        for p in range(np.uint64(PIXELS)):
            through = image[TRANSMITTANCE, p]
            rest[p] = (
                g[RED, p] * (image[RED, p] + through * behind[RED, p])
                + g[GREEN, p] * (image[GREEN, p] + through * behind[GREEN, p])
                + g[BLUE, p] * (image[BLUE, p] + through * behind[BLUE, p])
                + g[DEPTH, p] * image[DEPTH, p]
                + g[TRANSMITTANCE, p] * (np.float32(1) - through)
            )
        for entry in range(start[tile], start[tile] + last[tile]):
            i = splat[entry]
            u, v = projected[i, 0] - left, projected[i, 1] - top
            a, b, c = projected[i, 2], projected[i, 3], projected[i, 4]
            opacity, z, slope_x, slope_y = projected[i, 5], projected[i, 8], projected[i, 9], projected[i, 10]
            red, green, blue = parameters[i, 11], parameters[i, 12], parameters[i, 13]
            first = max(int(v - projected[i, 7]), 0)
            end = min(int(v + projected[i, 7]) + 2, SIZE)
            s0, s1, s2, s3, s4 = np.float32(0), np.float32(0), np.float32(0), np.float32(0), np.float32(0)
            s5, s6, s7, s8, s9 = np.float32(0), np.float32(0), np.float32(0), np.float32(0), np.float32(0)
            for p in range(np.uint64(first * SIZE), np.uint64(end * SIZE)):
                dx, dy = X[p] - u, Y[p] - v
                square = a * dx * dx + TWO * b * dx * dy + c * dy * dy
                q = min(square, FARTHEST) * np.float32(1 / 32)
                k = E0 + q * (E1 + q * (E2 + q * E3))
                k = k * k
                k = k * k
                k = k * k
                k = k * k
                alpha = min(opacity * k, MAX_ALPHA)
                alpha = alpha if alpha >= MIN_ALPHA else np.float32(0)
                weight = alpha * T[p]
                depth = z + slope_x * dx + slope_y * dy
                inverse = np.float32(1) / max(expected[p], NEAREST)
                deviation = (depth - expected[p]) * inverse
                shown = min(abs(deviation), MAX_DEVIATION) if expected[p] > 0 else depth
                value = g[RED, p] * red + g[GREEN, p] * green + g[BLUE, p] * blue
                value += g[DEPTH, p] * shown + g[TRANSMITTANCE, p]
                rest[p] -= weight * value
                by_alpha = T[p] * value - rest[p] / (np.float32(1) - alpha)
                by_alpha = by_alpha if MIN_ALPHA <= opacity * k < MAX_ALPHA else np.float32(0)
                T[p] -= weight
                by_square = np.float32(-0.5) * opacity * k * by_alpha
                s0 += weight * g[RED, p]
                s1 += weight * g[GREEN, p]
                s2 += weight * g[BLUE, p]
                by_depth = inverse if deviation > 0 else -inverse
                by_depth = by_depth if abs(deviation) < MAX_DEVIATION else np.float32(0)
                s3 += weight * g[DEPTH, p] * (by_depth if expected[p] > 0 else np.float32(1))
                s4 += by_alpha * k
                s5 += by_square * (a * dx + b * dy)
                s6 += by_square * (b * dx + c * dy)
                s7 += by_square * dx * dx
                s8 += by_square * dx * dy
                s9 += by_square * dy * dy
            e = entries[slot[entry]]
            e[0], e[1], e[2], e[3], e[4] = s0, s1, s2, s3, s4
            e[5], e[6], e[7], e[8], e[9] = -2 * s5, -2 * s6, s7, 2 * s8, s9
