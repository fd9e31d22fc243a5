"""Photometric loss of training, and its derivative: Charbonnier of the colours, and SSIM of the luminance."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.types import F32

CHARBONNIER = 0.04
"""Difference (sRGB 0 to 1) around which the penalty changes from quadratic to linear."""
SSIM_SHARE = 0.2
LUMINANCE = np.array([0.299, 0.587, 0.114], np.float32)
WINDOW_PX, WINDOW_SIGMA_PX = 11, 1.5
C1, C2 = 0.01**2, 0.03**2
CLIPPED_LOW, CLIPPED_HIGH = 0.01, 0.99
"""Where a photo is clipped, a rendering beyond is as good."""


def photometric(rendered: F32, photo: F32, weight: F32) -> tuple[float, F32]:
    """Loss per pixel, and its derivative by `rendered`, times the number of pixels.

    Args:
        rendered: (H, W, 3) rendering, sRGB, may exceed 0 to 1.
        photo: (H, W, 3) sRGB 0 to 1.
        weight: (H, W) weights of the pixels, 0 to 1.
    """
    # what isn't used is equal in both, so that it has no effect on windows across the mask's border
    shown = np.where(weight[..., None] > 0, np.clip(rendered, 0, 1), photo)
    difference = shown - photo
    root = np.sqrt(difference * difference + np.float32(CHARBONNIER**2))
    similarity, by_luminance = ssim(shown @ LUMINANCE, photo @ LUMINANCE, weight)
    gradient = np.float32((1 - SSIM_SHARE) / 3) * (difference / root)
    gradient -= np.float32(SSIM_SHARE / 2) * by_luminance[..., None] * LUMINANCE
    gradient *= weight[..., None]
    free = ((rendered > 1) & (photo > CLIPPED_HIGH)) | ((rendered < 0) & (photo < CLIPPED_LOW))
    total = float(weight.sum()) or 1.0
    charbonnier = float(((root.mean(axis=-1) - CHARBONNIER) * weight).sum()) / total
    value = (1 - SSIM_SHARE) * charbonnier + SSIM_SHARE / 2 * (1 - similarity / total)
    return value, np.where(free, np.float32(0), gradient)


def ssim(x: F32, y: F32, weight: F32) -> tuple[float, F32]:
    """Weighted sum of the SSIM (Wang et al. 2004) of images (H, W) 0 to 1, and its derivative by `x`."""
    mx, my = _blurred(x), _blurred(y)
    sxx, syy, sxy = _blurred(x * x) - mx * mx, _blurred(y * y) - my * my, _blurred(x * y) - mx * my
    a1, a2 = 2 * mx * my + np.float32(C1), 2 * sxy + np.float32(C2)
    b1, b2 = mx * mx + my * my + np.float32(C1), sxx + syy + np.float32(C2)
    similarity = a1 * a2 / (b1 * b2)
    by_xx, by_xy = -weight * similarity / b2, weight * 2 * a1 / (b1 * b2)
    by_mean = weight * (2 * my * a2 / (b1 * b2) - 2 * mx * similarity / b1) - 2 * mx * by_xx - my * by_xy
    gradient = _blurred(by_mean) + 2 * x * _blurred(by_xx) + y * _blurred(by_xy)
    return float((weight * similarity).sum()), gradient


def _blurred(image: F32) -> F32:
    """An image blurred by the window; beyond its borders are zeros, so that the blur is its own adjoint."""
    import cv2

    size = (WINDOW_PX, WINDOW_PX)
    return np.asarray(cv2.GaussianBlur(image, size, WINDOW_SIGMA_PX, borderType=cv2.BORDER_CONSTANT), np.float32)
