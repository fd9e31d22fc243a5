"""Timecode: capture time drawn into an image, and read from the decoded image, to measure glass-to-glass latency.

Two rows of 16 squares, dark and light: 24 bits of time in ticks of 0.1 ms (it wraps after 28 minutes), and 8 bits of
checksum. Squares survive low bit rates; a square that is neither dark nor light makes the timecode unreadable.
"""

from __future__ import annotations

import zlib

import numpy as np

from scan2sim.pipeline.core.types import U8

SQUARE_PX, COLUMNS, ROWS = 16, 16, 2
"""Side of a square; number of squares."""
SQUARE_MIN_PX = 4
"""Minimum side of a readable square."""
DARK, LIGHT = 48, 208
GREY_MARGIN = 32
"""Grey levels around the middle that are neither dark nor light."""
TICK_NS = 100_000
"""Resolution of the timecode."""
TICK_RANGE = 1 << 24
"""Number of ticks after which the timecode wraps."""


def draw(image: U8, captured: int) -> None:
    """Draw a time (ns) into the upper left corner of an (H, W, 3) image at least 256 pixels wide."""
    code = _encode(captured // TICK_NS % TICK_RANGE)
    grey = np.where(code, LIGHT, DARK).astype(np.uint8).repeat(SQUARE_PX, 0).repeat(SQUARE_PX, 1)
    image[: ROWS * SQUARE_PX, : COLUMNS * SQUARE_PX] = grey[..., None]


def read(image: U8, near: int, width: int) -> int | None:
    """Read the time drawn into an image; None: it is not readable.

    Args:
        image: (H, W, 3) RGB, possibly downscaled.
        near: time in nanoseconds, within 14 minutes of the drawn time.
        width: pixels of the image before downscaling.
    """
    side = SQUARE_PX * image.shape[1] / width
    if side < SQUARE_MIN_PX or image.shape[0] < ROWS * side:
        return None
    quarter = round(side / 4)
    greys = np.empty((ROWS, COLUMNS))
    for row in range(ROWS):
        for column in range(COLUMNS):
            y, x = (round((index + 0.5) * side) for index in (row, column))
            greys[row, column] = image[y - quarter : y + quarter, x - quarter : x + quarter].mean()
    if np.abs(greys - (DARK + LIGHT) / 2).min() < GREY_MARGIN:
        return None
    bits = np.packbits((greys > (DARK + LIGHT) / 2).ravel()).tobytes()
    if _checksum(bits[:3]) != bits[3]:
        return None
    ticks = int.from_bytes(bits[:3], "big")
    behind = (near // TICK_NS - ticks + TICK_RANGE // 2) % TICK_RANGE - TICK_RANGE // 2
    return (near // TICK_NS - behind) * TICK_NS


def _encode(ticks: int) -> U8:
    """Bits (ROWS, COLUMNS) of a timecode."""
    time = ticks.to_bytes(3, "big")
    bits = np.frombuffer(time + bytes([_checksum(time)]), np.uint8)
    return np.unpackbits(bits).reshape(ROWS, COLUMNS)


def _checksum(time: bytes) -> int:
    return zlib.crc32(time) & 0xFF
