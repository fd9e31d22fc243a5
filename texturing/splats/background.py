"""Background at infinity: a texture of all directions, equirectangular, with its gradient."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numba import njit, prange

from scan2sim.pipeline.core.splats import MAX_COLOUR, MIN_COLOUR
from scan2sim.pipeline.core.types import F32, F64

WIDTH_PX, HEIGHT_PX = 2560, 1280
"""Size of the texture: .14 degrees per texel. Column 0 is azimuth -180 degrees (from x to y), row 0 is the zenith."""
FIRST_MOMENT, SECOND_MOMENT, MIN_ROOT = 0.8, 0.95, 1e-3
"""Of Adam; texels whose gradients are smaller than the last hardly change."""
A0, A1, A2 = np.float32(0.99997726), np.float32(-0.33262347), np.float32(0.19354346)
A3, A4, A5 = np.float32(-0.11643287), np.float32(0.05265332), np.float32(-0.01172120)
PI, HALF_PI, TINY = np.float32(np.pi), np.float32(np.pi / 2), np.float32(1e-30)


class Background:
    """Colours of all directions.

    Attributes:
        texture: (`HEIGHT_PX`, `WIDTH_PX`, 3) sRGB, `MIN_COLOUR` to `MAX_COLOUR`, as those of splats.
    """

    # _first, _second: moments of Adam; _total: gradient of a step, zero between steps

    def __init__(self, texture: F32) -> None:
        self.texture = np.asarray(texture, np.float32).copy()
        # `zeros` takes no memory before training writes to it
        self._first, self._second, self._total = (np.zeros(self.texture.shape, np.float32) for _ in range(3))

    def seen(self, texels: F32) -> F32:
        """(H, W, 3) colours at texels (H, W, 2), see `texels`."""
        import cv2

        found = cv2.remap(self.texture, texels[..., 0], texels[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        return np.asarray(found, np.float32)

    def descend(self, texels: F32, gradient: F32, rate: float) -> None:
        """Take a step (Adam, of the texels that are seen) against derivatives (H, W, 3) of a loss by `seen`."""
        touched = np.empty(4 * texels.shape[0] * texels.shape[1], np.int32)
        count = _scatter(texels.reshape(-1, 2), gradient.reshape(-1, 3), self._total, touched)
        limits = np.float32(MIN_COLOUR), np.float32(MAX_COLOUR)
        _step(self.texture, self._first, self._second, self._total, touched[:count], np.float32(rate), *limits)

    def recolour(self, factor: F32, offset: F32) -> None:
        """Multiply all colours by (3,) factors, and add (3,) offsets."""
        self.texture *= factor
        self.texture += offset
        np.clip(self.texture, MIN_COLOUR, MAX_COLOUR, out=self.texture)

    def save(self) -> dict[str, F32]:
        """State, for `load`."""
        return {"background": self.texture, "background_first": self._first, "background_second": self._second}

    @classmethod
    def load(cls, state: Mapping[str, F32]) -> Background:
        """The background that `save` describes."""
        loaded = cls(state["background"])
        loaded._first, loaded._second = state["background_first"].copy(), state["background_second"].copy()
        return loaded


def texels(directions: F64 | F32) -> F32:
    """Column and row (..., 2) of directions (..., 3) in the texture; any length. Columns are periodic, rows are not."""
    found = np.empty((*directions.shape[:-1], 2), np.float32)
    _texels(np.ascontiguousarray(directions.reshape(-1, 3), np.float32), WIDTH_PX, HEIGHT_PX, found.reshape(-1, 2))
    return found


def directions() -> F64:
    """(`HEIGHT_PX`, `WIDTH_PX`, 3) unit directions of the texels."""
    azimuth = ((np.arange(WIDTH_PX) + 0.5) / WIDTH_PX - 0.5) * 2 * np.pi
    elevation = (0.5 - (np.arange(HEIGHT_PX) + 0.5) / HEIGHT_PX)[:, None] * np.pi
    flat = np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation) + 0 * azimuth], axis=-1)


@njit(cache=True, inline="always")
def _angle(y, x):  # type: ignore[no-untyped-def]
    """Angle of (x, y), radians, as `arctan2`, within 3e-6: by a minimax polynomial, which LLVM vectorizes."""
    wide, high = abs(x), abs(y)
    ratio = min(wide, high) / max(max(wide, high), TINY)
    r = ratio * ratio
    angle = ratio * (A0 + r * (A1 + r * (A2 + r * (A3 + r * (A4 + r * A5)))))
    angle = HALF_PI - angle if high > wide else angle
    angle = PI - angle if x < 0 else angle
    return -angle if y < 0 else angle


@njit(cache=True, parallel=True, fastmath=True, error_model="numpy")
def _texels(directions, width, height, found):  # type: ignore[no-untyped-def]
    columns, rows = np.float32(width / (2 * np.pi)), np.float32(height / np.pi)
    middle, center, last = np.float32((width - 1) / 2), np.float32((height - 1) / 2), np.float32(height - 1)
    for i in prange(len(directions)):
        x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
        found[i, 0] = _angle(y, x) * columns + middle
        row = center - _angle(z, np.sqrt(x * x + y * y)) * rows
        found[i, 1] = min(max(row, np.float32(0)), last)


@njit(cache=True)
def _scatter(texels, values, total, touched):  # type: ignore[no-untyped-def]
    """Add values (N, 3) at texels (N, 2) to `total` (H, W, 3), which is zero before.

    It is the adjoint of the bilinear lookup `Background.seen`.

    Returns:
        the number of texels that changed; their indices are written to `touched`.
    """
    height, width = total.shape[:2]
    count = 0
    for i in range(len(texels)):
        if values[i, 0] == 0 and values[i, 1] == 0 and values[i, 2] == 0:
            continue
        x, y = texels[i, 0], min(max(texels[i, 1], np.float32(0)), np.float32(height - 1))
        left, top = int(np.floor(x)), min(int(y), height - 2)
        s, t = x - left, y - top
        for row, column, weight in (
            (top, left, (1 - s) * (1 - t)), (top, left + 1, s * (1 - t)),
            (top + 1, left, (1 - s) * t), (top + 1, left + 1, s * t),
        ):  # fmt: skip
            if weight == 0:
                continue
            column %= width
            texel = total[row, column]
            if texel[0] == 0 and texel[1] == 0 and texel[2] == 0:
                touched[count] = row * width + column
                count += 1
            for channel in range(3):
                texel[channel] += np.float32(weight) * values[i, channel]
    return count


@njit(cache=True)
def _step(texture, first, second, total, touched, rate, low, high):  # type: ignore[no-untyped-def]
    """A step of Adam, within low and high, against the derivatives `total` of texels `touched`, which become zero."""
    width = texture.shape[1]
    for index in touched:
        row, column = index // width, index % width
        for channel in range(3):
            g = total[row, column, channel]
            total[row, column, channel] = 0
            m = np.float32(FIRST_MOMENT) * first[row, column, channel] + np.float32(1 - FIRST_MOMENT) * g
            v = np.float32(SECOND_MOMENT) * second[row, column, channel] + np.float32(1 - SECOND_MOMENT) * g * g
            first[row, column, channel], second[row, column, channel] = m, v
            value = texture[row, column, channel] - rate * m / (np.sqrt(v) + np.float32(MIN_ROOT))
            texture[row, column, channel] = min(max(value, low), high)
