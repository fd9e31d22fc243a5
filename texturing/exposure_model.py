"""Exposure model: grey levels after a change of exposure, vignetting, and tone curve. Import late: it loads numba."""

from __future__ import annotations

import math

from numba import njit

from scan2sim.pipeline.core.types import F64
from scan2sim.texturing.photo_cache import SRGB_GAMMA, SRGB_OFFSET

TONE_KNEE_LEVEL = 230.0
"""Grey level above which highlights are compressed where the white point is above 255."""
OVEREXPOSED_POWER = 4.0
"""Exponent of a photo's gain in the weight of its overexposed pixels."""


@njit(cache=True, inline="always")
def vignette(exposure: F64, p: F64, u: float, v: float) -> float:
    """Factor that corrects a photo's vignetting at a pixel; `exposure` from `photo_cache.Exposures.of`."""
    if exposure[3] == 0.0 and exposure[4] == 0.0:
        return 1.0
    cx, cy = 0.5 * (p[12] - 1), 0.5 * (p[13] - 1)
    q = ((u - cx) ** 2 + (v - cy) ** 2) / (cx * cx + cy * cy)
    return math.exp(exposure[3] * q + exposure[4] * q * q)


@njit(cache=True, inline="always")
def corrected(value: float, factor: float) -> float:
    """Encoded grey level after an exposure change by `factor`, a factor of (value + offset) in the power law."""
    return (value + SRGB_OFFSET) * factor - SRGB_OFFSET


@njit(cache=True, inline="always")
def compressed(level: float, white: float) -> float:
    """Grey level after the tone curve that maps `white` (at least 255) to 255 and keeps levels below the knee."""
    if level <= TONE_KNEE_LEVEL:
        return level
    above = level - TONE_KNEE_LEVEL
    return TONE_KNEE_LEVEL + above / (1 + above * (1 / (255 - TONE_KNEE_LEVEL) - 1 / (white - TONE_KNEE_LEVEL)))


@njit(cache=True, inline="always")
def overexposed_weight(exposure: F64) -> float:
    """Factor on the weight of a photo's overexposed pixels; `exposure` from `photo_cache.Exposures.of`.

    An overexposed pixel is at least white. In a photo that is brightened it stays so, as it does in the world; in one
    that is darkened it becomes a grey that is too dark.
    """
    return min(1.0, math.exp(OVEREXPOSED_POWER * SRGB_GAMMA * (exposure[0] + exposure[1] + exposure[2]) / 3))
