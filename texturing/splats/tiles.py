"""Assignment of projected splats to the tiles of an image, nearest first, and images in the order of tiles."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from scan2sim.pipeline.core.types import F32, I32, Bools
from scan2sim.texturing.splats.blending import HEIGHT, MIN_ALPHA, PIXELS, WIDTH
from scan2sim.texturing.splats.projection import DEPTH

DEPTH_LEVELS = 2**16 - 1
"""Number of levels of the logarithm of depths, by which splats are sorted: a thousandth of the depth or better."""


class Assignment(NamedTuple):
    """Which splats each tile shows.

    Attributes:
        columns: number of tiles in a row of the image.
        start: (T + 1,) first entry of each tile.
        splat: (E,) splat of each entry, nearest first within a tile.
        visible: (M,) the visible splats, nearest first.
        first: (M + 1,) first place in `entries` of each of them.
        slot: (E,) place of each entry in the order of `visible`, in which the entries of a splat are in sequence.
    """

    columns: int
    start: I32
    splat: I32
    visible: I32
    first: I32
    slot: I32


def assign(projected: F32, visible: Bools, width: int, height: int) -> Assignment:
    """Assign visible splats (of N, (N, 11)) to the tiles that they reach."""
    columns, rows = -(-width // WIDTH), -(-height // HEIGHT)
    index = np.flatnonzero(visible)
    depth = np.log(projected[index, DEPTH])
    low, high = (float(depth.min()), float(depth.max())) if len(depth) else (0.0, 1.0)
    level = ((depth - low) * (DEPTH_LEVELS / max(high - low, 1e-6))).astype(np.uint16)
    index = index[np.argsort(level, kind="stable")].astype(np.int32)  # a radix sort for 16 bits
    return Assignment(columns, *_assign(projected, index, columns, rows, WIDTH, HEIGHT, MIN_ALPHA))


def to_tiles(image: F32) -> F32:
    """An image (H, W, C) as (T, C, 256), row by row of tiles, filled up with zeros."""
    height, width, channels = image.shape
    rows, columns = -(-height // HEIGHT), -(-width // WIDTH)
    padded = np.zeros((rows * HEIGHT, columns * WIDTH, channels), np.float32)
    padded[:height, :width] = image
    tiles = padded.reshape(rows, HEIGHT, columns, WIDTH, channels).transpose(0, 2, 4, 1, 3)
    return np.ascontiguousarray(tiles).reshape(rows * columns, channels, PIXELS)


def from_tiles(tiles: F32, width: int, height: int) -> F32:
    """The image (H, W, C) of tiles (T, C, 256)."""
    rows, columns = -(-height // HEIGHT), -(-width // WIDTH)
    image = tiles.reshape(rows, columns, -1, HEIGHT, WIDTH).transpose(0, 3, 1, 4, 2)
    return np.ascontiguousarray(image.reshape(rows * HEIGHT, columns * WIDTH, -1)[:height, :width])


@njit(cache=True, inline="always")
def _overlap(projected, i, columns, rows, width, height):  # type: ignore[no-untyped-def]
    """First and last column and row of the tiles, of width x height pixels, that a splat overlaps."""
    u, v, x, y = projected[i, 0], projected[i, 1], projected[i, 6], projected[i, 7]
    return (
        int(max(u - x, np.float32(0)) / width), min(int((u + x) / width), columns - 1),
        int(max(v - y, np.float32(0)) / height), min(int((v + y) / height), rows - 1),
    )  # fmt: skip


@njit(cache=True, inline="always")
def _reaches(projected, i, x, y, width, height, farthest):  # type: ignore[no-untyped-def]
    """Whether the ellipse of a splat at the squared distance `farthest` reaches the tile in column x and row y."""
    left, top = np.float32(x * width) - projected[i, 0], np.float32(y * height) - projected[i, 1]
    right, bottom = left + np.float32(width - 1), top + np.float32(height - 1)
    dx, dy = min(max(np.float32(0), left), right), min(max(np.float32(0), top), bottom)
    if dx == 0 and dy == 0:
        return True
    a, b, c = projected[i, 2], projected[i, 3], projected[i, 4]
    # the nearest pixel is on one of the sides that face the centre
    if dx != 0:
        at = min(max(-b * dx / c, top), bottom)
        if a * dx * dx + 2 * b * dx * at + c * at * at <= farthest:
            return True
    if dy != 0:
        at = min(max(-b * dy / a, left), right)
        if a * at * at + 2 * b * at * dy + c * dy * dy <= farthest:
            return True
    return False


@njit(cache=True)
def _assign(projected, index, columns, rows, width, height, min_alpha):  # type: ignore[no-untyped-def]
    """Entries of the tiles (`Assignment`): rows x columns of width x height pixels."""
    most = 0
    for m in range(len(index)):
        left, right, top, bottom = _overlap(projected, index[m], columns, rows, width, height)
        most += (right - left + 1) * (bottom - top + 1)
    tile_of = np.empty(most, np.int32)  # of the entries, those of a splat in sequence
    start = np.zeros(columns * rows + 1, np.int32)
    first = np.zeros(len(index) + 1, np.int32)
    count = 0
    for m in range(len(index)):
        i = index[m]
        left, right, top, bottom = _overlap(projected, i, columns, rows, width, height)
        farthest = _farthest(projected, i, min_alpha)
        for y in range(top, bottom + 1):
            for x in range(left, right + 1):
                if _reaches(projected, i, x, y, width, height, farthest):
                    tile_of[count] = y * columns + x
                    start[tile_of[count] + 1] += 1
                    count += 1
        first[m + 1] = count
    for tile in range(columns * rows):
        start[tile + 1] += start[tile]
    free = start[:-1].copy()
    splat, slot = np.empty(count, np.int32), np.empty(count, np.int32)
    for m in range(len(index)):
        for place in range(first[m], first[m + 1]):
            tile = tile_of[place]
            splat[free[tile]], slot[free[tile]] = index[m], place
            free[tile] += 1
    return start, splat, index, first, slot


@njit(cache=True, inline="always")
def _farthest(projected, i, min_alpha):  # type: ignore[no-untyped-def]
    """Squared distance in standard deviations at which a splat's alpha is `min_alpha`, and a little more."""
    return np.float32(2.01) * np.log(projected[i, 5] / min_alpha) + np.float32(0.01)
