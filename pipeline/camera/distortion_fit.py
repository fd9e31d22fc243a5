"""Fit OpenCV distortion coefficients to lens models of other programs."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from scan2sim.pipeline.core.types import F64

MAX_FIT_ERROR_PX = 0.05
"""Largest accepted error of a fitted lens: a tenth of the best reprojection errors of photos."""


def fit_radial(factor: Callable[[F64], F64], max_radius: float, focal: float) -> tuple[F64, float]:
    """Fit OpenCV's radial coefficients to a lens whose distorted radius is r * `factor(r)`.

    OpenCV's k1...k6 are a rational function (cubic polynomials in r2), fitted by linearized least squares with
    iterative reweighting (Sanathanan and Koerner, Transfer function synthesis as a ratio of two complex polynomials,
    1963).

    Args:
        factor: function of (N,) undistorted radii (tangents of the angle to the optical axis).
        max_radius: largest undistorted radius inside the image.
        focal: focal length in pixels.

    Returns:
        (6,) k1 k2 k3 k4 k5 k6, and the largest error in pixels up to `max_radius`.
    """
    r = np.linspace(0, max_radius, 2000)[1:]
    target, s = factor(r), (r / max_radius) ** 2  # powers of values up to 1 are better conditioned
    powers = np.stack([s, s**2, s**3], axis=1)
    best, max_error = np.zeros(6), np.inf
    for denominator_terms in range(4):  # more terms fit better, but may have a pole inside the image
        rows, weight, k = np.hstack([powers, -target[:, None] * powers[:, :denominator_terms]]), r, np.zeros(6)
        for _ in range(5):  # weighting by the previous denominator makes the residual that of the quotient
            k[: 3 + denominator_terms] = np.linalg.lstsq(rows * weight[:, None], (target - 1) * weight, rcond=1e-13)[0]
            weight = r / np.maximum(np.abs(1 + powers @ k[3:]), 1e-9)
        divisor = 1 + powers @ k[3:]
        error = np.abs((1 + powers @ k[:3]) / divisor - target) * r if (divisor > 0).all() else np.full(1, np.inf)
        if error.max() * focal < max_error:
            best, max_error = k, float(error.max() * focal)
    return best / np.tile(max_radius ** np.array([2.0, 4.0, 6.0]), 2), max_error


def max_distorted_radius(width: int, height: int, fx: float, fy: float, cx: float, cy: float) -> float:
    """Largest distorted radius in an image: that of the corner farthest from the principal point."""
    x = np.array([-0.5 - cx, width - 0.5 - cx]) / fx
    y = np.array([-0.5 - cy, height - 0.5 - cy]) / fy
    return float(np.hypot(np.abs(x).max(), np.abs(y).max()))
