"""The time of capture drawn into a picture and read from the decoded one: how long it takes from glass to glass.

Two rows of 16 squares, dark and light: 24 bits of time in steps of 0.1 ms (it begins again after 28 minutes), and 8 to
check. Their places and greys survive low bit rates; a square that is neither dark nor light makes the mark unreadable.
"""

from __future__ import annotations

import zlib

import numpy as np

from scan2sim.pipeline.core.types import U8

SQUARE, COLUMNS, ROWS = 16, 16, 2
"""Pixels of a square's side, and squares."""
SMALLEST = 4
"""Of a side that can be read."""
DARK, LIGHT = 48, 208
UNSURE = 32
"""Grey levels about the middle that are neither."""
STEP = 100_000
"""Nanoseconds."""
SPAN = 1 << 24
"""Steps after which it begins again."""


def mark(image: U8, captured: int) -> None:
    """Draw a time, nanoseconds, into the upper left corner of an (H, W, 3) picture, at least 256 pixels wide."""
    code = _coded(captured // STEP % SPAN)
    grey = np.where(code, LIGHT, DARK).astype(np.uint8).repeat(SQUARE, 0).repeat(SQUARE, 1)
    image[: ROWS * SQUARE, : COLUMNS * SQUARE] = grey[..., None]


def read(image: U8, near: int, width: int) -> int | None:
    """The time that is drawn into a picture; None: none can be read.

    Args:
        image: (H, W, 3) RGB, maybe made smaller meanwhile.
        near: nanoseconds that it is near, by 14 minutes.
        width: pixels of the picture that it was drawn into.
    """
    side = SQUARE * image.shape[1] / width
    if side < SMALLEST or image.shape[0] < ROWS * side:
        return None
    quarter = round(side / 4)
    greys = np.empty((ROWS, COLUMNS))
    for row in range(ROWS):
        for column in range(COLUMNS):
            y, x = (round((place + 0.5) * side) for place in (row, column))
            greys[row, column] = image[y - quarter : y + quarter, x - quarter : x + quarter].mean()
    if np.abs(greys - (DARK + LIGHT) / 2).min() < UNSURE:
        return None
    bits = np.packbits((greys > (DARK + LIGHT) / 2).ravel()).tobytes()
    if _check(bits[:3]) != bits[3]:
        return None
    steps = int.from_bytes(bits[:3], "big")
    behind = (near // STEP - steps + SPAN // 2) % SPAN - SPAN // 2
    return (near // STEP - behind) * STEP


def _coded(steps: int) -> U8:
    """(ROWS, COLUMNS) bits."""
    time = steps.to_bytes(3, "big")
    bits = np.frombuffer(time + bytes([_check(time)]), np.uint8)
    return np.unpackbits(bits).reshape(ROWS, COLUMNS)


def _check(time: bytes) -> int:
    return zlib.crc32(time) & 0xFF
