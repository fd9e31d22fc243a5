"""Lenses that other programs describe in their own ways, as OpenCV's coefficients."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from scan2sim.pipeline.core.types import F64

EXACT = 0.05
"""Pixels that a fitted lens may be off at worst: a tenth of what photos fit to in the best of cases."""


def radial(factor: Callable[[F64], F64], reach: float, focal: float) -> tuple[F64, float]:
    """OpenCV's radial coefficients of a lens that moves what is seen at radius r to r * `factor(r)`.

    A rational of third degree in r2 over another, which OpenCV's k1...k6 are, is fitted by least squares, made linear
    as Sanathanan and Koerner do (Transfer function synthesis as a ratio of two complex polynomials, 1963).

    Args:
        factor: of (N,) radii, tangents of angles to the axis, without distortion.
        reach: largest radius that is in the picture.
        focal: pixels.

    Returns:
        (6,) k1 k2 k3 k4 k5 k6, and how many pixels they are off at worst, up to `reach`.
    """
    r = np.linspace(0, reach, 2000)[1:]
    wanted, s = factor(r), (r / reach) ** 2  # powers of what is at most 1: better conditioned
    powers = np.stack([s, s**2, s**3], axis=1)
    best, off = np.zeros(6), np.inf
    for below in range(4):  # terms of the denominator: more of them fit better, but may have a pole within reach
        rows, weight, k = np.hstack([powers, -wanted[:, None] * powers[:, :below]]), r, np.zeros(6)
        for _ in range(5):  # weighted by the last round's denominator, the error is that of the quotient itself
            k[: 3 + below] = np.linalg.lstsq(rows * weight[:, None], (wanted - 1) * weight, rcond=1e-13)[0]
            weight = r / np.maximum(np.abs(1 + powers @ k[3:]), 1e-9)
        divisor = 1 + powers @ k[3:]
        error = np.abs((1 + powers @ k[:3]) / divisor - wanted) * r if (divisor > 0).all() else np.full(1, np.inf)
        if error.max() * focal < off:
            best, off = k, float(error.max() * focal)
    return best / np.tile(reach ** np.array([2.0, 4.0, 6.0]), 2), off


def reach(width: int, height: int, fx: float, fy: float, cx: float, cy: float) -> float:
    """The largest distorted radius in a picture: that of the corner which is farthest from the axis."""
    x = np.array([-0.5 - cx, width - 0.5 - cx]) / fx
    y = np.array([-0.5 - cy, height - 0.5 - cy]) / fy
    return float(np.hypot(np.abs(x).max(), np.abs(y).max()))
