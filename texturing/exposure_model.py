"""Exposure model of a photo: grey levels after a change of exposure, and vignetting. Import late: it loads numba."""

from __future__ import annotations

import math

from numba import njit

from scan2sim.pipeline.core.types import F64
from scan2sim.texturing.photo_cache import SRGB_OFFSET


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
