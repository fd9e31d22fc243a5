"""Exposure: how much brighter one picture is than another, by what both show; pictures made alike for Lucas-Kanade.

Lucas-Kanade takes a place for the same where grey values are the same. Cameras change their exposure: a gain and an
offset (Jin, Favaro and Soatto 2001) are solved between every two frames from the values about the features themselves,
so that what comes into view doesn't count as light.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from scan2sim.pipeline.core.types import F32, F64, U8, Bools

ENOUGH = 30
"""Features from which both numbers can be told."""
AROUND = 17
"""Pixels, of the square about a feature whose mean is taken: Lucas-Kanade's larger one."""
SURROUNDINGS = 31
"""Pixels, of the square about a pixel whose mean is taken from it: well over Lucas-Kanade's smaller one."""
STEADY = 0.05
"""Gains nearer to 1 than this, and changes of the mean below it, aren't told from none: where the exposure is held,
what comes nearer looks otherwise by some 2 % (one standard deviation; two real streets and a rendered one), which
isn't light. What is followed is aligned with its first look afterwards, whatever the light (`patches.py`): on three
real streets, little depends on this number."""
DARKEST = 50.0
"""A picture whose values spread so many times less shows nothing."""
OFF = 2.5 * 1.4826
"""Times the median residual beyond which a feature isn't believed."""


class Exposure(NamedTuple):
    """A second picture's grey values are `gain` x those of the first, plus `offset`."""

    gain: float = 1.0
    offset: float = 0.0

    def alike(self, first: U8, second: U8) -> tuple[U8, U8]:
        """Both, the darker made as bright as the other."""
        if self.gain < 1:
            return first, _lit(second, 1 / self.gain, -self.offset / self.gain)
        return _lit(first, self.gain, self.offset), second


def level(picture: U8) -> U8:
    """By how much each value is above the mean about it, plus 128: how bright the picture is doesn't count any more.

    Lucas-Kanade shifts a feature by what its square is brighter or darker by, and by as much back: unnoticed.
    """
    import cv2

    mean = cv2.blur(picture, (SURROUNDINGS, SURROUNDINGS))
    return np.asarray(cv2.addWeighted(picture, 1.0, mean, -1.0, 128.0), np.uint8)


def _lit(picture: U8, gain: float, offset: float) -> U8:
    import cv2

    table = np.clip(np.round(gain * np.arange(256) + offset), 0, 255).astype(np.uint8)
    return picture if (gain, offset) == (1, 0) else np.asarray(cv2.LUT(picture, table), np.uint8)


def between(first: U8, second: U8, there: F32, now: F32) -> Exposure:
    """The exposure of a second picture against a first; by the pictures as a whole, where too few features tell.

    Args:
        first, second: (H, W).
        there, now: (N, 2) the same features in both, pixels; those outside or NaN don't count.
    """
    inside = _inside(first, there) & _inside(second, now)
    if inside.sum() < ENOUGH:
        return _line(first, second)
    a, b = _values(first, there[inside]), _values(second, now[inside])
    keep = np.ones(len(a), bool)
    for _ in range(3):
        gain, offset = _line(a[keep], b[keep], steady=0)
        residual = np.abs(b - gain * a - offset)
        keep = residual <= OFF * np.median(residual)
    return _line(a[keep], b[keep])


def _line(a: F64 | U8, b: F64 | U8, steady: float = STEADY) -> Exposure:
    """That which gives values `a` the mean and the spread of values `b`: neither picture is the truth."""
    gain, brighter = float(b.std() / max(a.std(), 1.0)), float(b.mean() / max(a.mean(), 1.0))
    if max(abs(gain - 1), abs(brighter - 1)) < steady or gain < 1 / DARKEST:
        return Exposure()
    return Exposure(gain, float(b.mean() - gain * a.mean()))


def _inside(picture: U8, uv: F32) -> Bools:
    height, width = picture.shape
    return np.asarray(((uv > 0) & (uv < (width - 1, height - 1))).all(axis=1))  # NaN isn't


def _values(picture: U8, uv: F32) -> F64:
    """(N,) mean grey values about places (N, 2)."""
    import cv2

    column, row = np.round(uv).astype(np.int64).T
    return np.asarray(cv2.blur(picture, (AROUND, AROUND))[row, column], np.float64)
