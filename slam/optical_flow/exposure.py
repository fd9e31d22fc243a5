"""Exposure compensation: gain and offset between two images, applied before Lucas-Kanade optical flow.

Lucas-Kanade assumes brightness constancy, but cameras change their exposure. A gain and an offset (Jin, Favaro and
Soatto 2001) are estimated between consecutive frames from the grey values around common features, so that objects that
enter the view don't bias them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from scan2sim.pipeline.core.types import F32, F64, U8, Bools

FEATURES_MIN = 30
"""Common features needed to estimate gain and offset."""
FEATURE_WINDOW_PX = 17
"""Side of the square around a feature whose mean grey value is compared: the larger Lucas-Kanade window."""
LOCAL_MEAN_WINDOW_PX = 31
"""Side of the square whose mean is subtracted from its central pixel: well over the smaller Lucas-Kanade window."""
CHANGE_MIN = 0.05
"""Relative change of gain or mean below which the exposure counts as constant. At constant exposure, the appearance of
approaching objects changes by some 2 % (one standard deviation, on two real streets and a rendered one). Tracks are
afterwards aligned with their first template whatever the exposure (`patch_alignment.py`): on three real streets, the
result depends little on this value."""
GAIN_MIN = 1 / 50.0
"""Gain below which the second image is considered blank."""
OUTLIER_RESIDUAL = 2.5 * 1.4826
"""Multiple of the median residual beyond which a feature is rejected."""


class Exposure(NamedTuple):
    """Exposure change: grey values of the second image are `gain` x those of the first, plus `offset`."""

    gain: float = 1.0
    offset: float = 0.0

    def equalize(self, first: U8, second: U8) -> tuple[U8, U8]:
        """Both images (H, W) at the same exposure; the darker one is brightened."""
        if self.gain < 1:
            return first, _apply(second, 1 / self.gain, -self.offset / self.gain)
        return _apply(first, self.gain, self.offset), second


def subtract_local_mean(image: U8) -> U8:
    """Difference of each pixel from its local mean, plus 128: removes what is left of an exposure change.

    Without this, Lucas-Kanade shifts a feature in proportion to the brightness change of its window, and by as much
    back, so that the forward-backward check doesn't detect it.
    """
    import cv2

    mean = cv2.blur(image, (LOCAL_MEAN_WINDOW_PX, LOCAL_MEAN_WINDOW_PX))
    return np.asarray(cv2.addWeighted(image, 1.0, mean, -1.0, 128.0), np.uint8)


def _apply(image: U8, gain: float, offset: float) -> U8:
    import cv2

    table = np.clip(np.round(gain * np.arange(256) + offset), 0, 255).astype(np.uint8)
    return image if (gain, offset) == (1, 0) else np.asarray(cv2.LUT(image, table), np.uint8)


def estimate(first: U8, second: U8, uv_first: F32, uv_second: F32) -> Exposure:
    """Exposure of the second image relative to the first; from the whole images if there are too few features.

    Args:
        first, second: (H, W).
        uv_first, uv_second: (N, 2) pixels of common features; those outside an image and NaN are ignored.
    """
    inside = _inside(first, uv_first) & _inside(second, uv_second)
    if inside.sum() < FEATURES_MIN:
        return _moment_fit(first, second)
    a, b = _local_means(first, uv_first[inside]), _local_means(second, uv_second[inside])
    keep = np.ones(len(a), bool)
    for _ in range(3):
        gain, offset = _moment_fit(a[keep], b[keep], change_min=0)
        residual = np.abs(b - gain * a - offset)
        keep = residual <= OUTLIER_RESIDUAL * np.median(residual)
    return _moment_fit(a[keep], b[keep])


def _moment_fit(a: F64 | U8, b: F64 | U8, change_min: float = CHANGE_MIN) -> Exposure:
    """Gain and offset that give values `a` the mean and standard deviation of values `b`; symmetric in both."""
    gain, brighter = float(b.std() / max(a.std(), 1.0)), float(b.mean() / max(a.mean(), 1.0))
    if max(abs(gain - 1), abs(brighter - 1)) < change_min or gain < GAIN_MIN:
        return Exposure()
    return Exposure(gain, float(b.mean() - gain * a.mean()))


def _inside(image: U8, uv: F32) -> Bools:
    height, width = image.shape
    return np.asarray(((uv > 0) & (uv < (width - 1, height - 1))).all(axis=1))  # False for NaN


def _local_means(image: U8, uv: F32) -> F64:
    """(N,) mean grey values of the squares around pixels (N, 2)."""
    import cv2

    column, row = np.round(uv).astype(np.int64).T
    return np.asarray(cv2.blur(image, (FEATURE_WINDOW_PX, FEATURE_WINDOW_PX))[row, column], np.float64)
