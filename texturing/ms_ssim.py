"""Multi-scale structural similarity (MS-SSIM) of two images, with a mask.

Wang, Simoncelli and Bovik, "Multi-scale structural similarity for image quality assessment", Asilomar 2003: contrast
and structure are compared at five scales, luminance at the coarsest one. It is less sensitive to detail that is shifted
by a pixel than SSIM, and more to shapes that are missing. Without masked pixels, values are those of the reference.
"""

from __future__ import annotations

import math

import numpy as np

from scan2sim.pipeline.core.types import F32, U8, Bools

WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
"""Exponents of the scales, the finest first (Wang et al. 2003)."""
WINDOW_PX, WINDOW_SIGMA_PX = 11, 1.5
"""Side length and sigma of the Gaussian window."""
LUMINANCE_CONSTANT, CONTRAST_CONSTANT = (0.01 * 255) ** 2, (0.03 * 255) ** 2
COUNTED_WEIGHT_MIN = 0.5
"""Share of a window's weight that must be within the mask."""
SIDE_MIN_PX = WINDOW_PX * 2 ** (len(WEIGHTS) - 1)
"""Smallest side length of an image: at the coarsest scale, one window fits in."""


def ms_ssim(a: U8, b: U8, mask: Bools | None = None) -> float:
    """MS-SSIM of two RGB images, from their grey levels; 1: equal, near 0: nothing in common.

    Args:
        a, b: (H, W, 3) images.
        mask: (H, W) pixels that are counted: others are excluded from all windows. None: all.

    Returns:
        NaN if a side is shorter than `SIDE_MIN_PX`, or no window lies mostly within the mask.
    """
    import cv2

    if min(a.shape[:2]) < SIDE_MIN_PX:
        return math.nan
    x, y = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) for image in (a, b))
    weight = np.ones(x.shape, np.float32) if mask is None else mask.astype(np.float32)
    result = 1.0
    for scale, exponent in enumerate(WEIGHTS):
        luminance, contrast = _terms(np.asarray(x, np.float32), np.asarray(y, np.float32), weight)
        term = contrast * luminance if scale == len(WEIGHTS) - 1 else contrast
        counted = ~np.isnan(term)
        if not counted.any():
            return math.nan
        result *= max(float(term[counted].mean(dtype=np.float64)), 0.0) ** exponent
        share = _half(weight)
        x, y = (_half(image * weight) / np.maximum(share, 1e-6) for image in (x, y))
        weight = share
    return result


def _terms(x: F32, y: F32, weight: F32) -> tuple[F32, F32]:
    """Terms of luminance, and of contrast and structure, of the windows within the image; NaN outside the mask."""
    import cv2

    margin = WINDOW_PX // 2

    def mean(image: F32) -> F32:
        blurred = cv2.GaussianBlur(image, (WINDOW_PX, WINDOW_PX), WINDOW_SIGMA_PX)
        return np.asarray(blurred[margin:-margin, margin:-margin], np.float32)

    total = mean(weight)
    scale = 1 / np.maximum(total, np.float32(1e-6))
    mx, my = mean(x * weight) * scale, mean(y * weight) * scale
    vx, vy = mean(x * x * weight) * scale - mx * mx, mean(y * y * weight) * scale - my * my
    covariance = mean(x * y * weight) * scale - mx * my
    luminance = (2 * mx * my + LUMINANCE_CONSTANT) / (mx * mx + my * my + LUMINANCE_CONSTANT)
    contrast = (2 * covariance + CONTRAST_CONSTANT) / (vx + vy + CONTRAST_CONSTANT)
    counted = (total >= COUNTED_WEIGHT_MIN) & (weight[margin:-margin, margin:-margin] > 0)
    return np.asarray(luminance, np.float32), np.where(counted, contrast, np.float32(np.nan)).astype(np.float32)


def _half(image: F32) -> F32:
    """Means over 2 x 2 pixels; an odd last row or column is dropped."""
    height, width = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
    blocks = image[:height, :width].reshape(height // 2, 2, width // 2, 2)
    return np.asarray(blocks.mean(axis=(1, 3), dtype=np.float32))
