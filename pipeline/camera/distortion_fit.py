"""Fit OpenCV distortion coefficients to lens models of other programs."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from scan2sim.pipeline.core.types import F64

MAX_FISHEYE_ANGLE = np.radians(105)
"""Angle to the axis that fisheye lenses reach, radians."""
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


def fit_fisheye(radius: Callable[[F64], F64], max_radius: float, focal: float) -> tuple[float, F64, float]:
    """Fit OpenCV's fisheye coefficients to a lens that is symmetric about its axis, such as the double sphere model.

    Args:
        radius: function of (N,) angles to the optical axis in radians: distorted radius, in focal lengths.
        max_radius: largest distorted radius inside the image, in focal lengths.
        focal: focal length in pixels.

    Returns:
        Focal length of the fisheye model as a multiple of `focal` (the slope of `radius` on the axis), (4,)
        k1 k2 k3 k4, and the largest error in pixels up to `max_radius`, or where that is less, up to
        `MAX_FISHEYE_ANGLE` and to where the radius decreases.
    """
    theta = np.linspace(0, MAX_FISHEYE_ANGLE, 4000)[1:]
    r, slope = radius(theta), float(radius(np.full(1, 1e-5))[0]) / 1e-5
    decreasing = np.flatnonzero(~(np.isfinite(r) & (np.diff(r, prepend=0.0) > 0)))
    end = int(decreasing[0]) if len(decreasing) else len(r)
    end = min(end, int(np.searchsorted(r[:end], max_radius)) + 1)
    if end < 2:
        return slope, np.zeros(4), np.inf
    theta, r, widest = theta[:end], r[:end], theta[end - 1]
    powers = np.stack([(theta / widest) ** n for n in (3, 5, 7, 9)], axis=1)
    k = np.linalg.lstsq(powers, r - slope * theta, rcond=1e-13)[0]
    error = float(np.abs(powers @ k + slope * theta - r).max()) * focal
    return slope, k / slope / widest ** np.array([3, 5, 7, 9]), error


def double_sphere_radius(xi: float, alpha: float, theta: F64) -> F64:
    """Radius of rays at angles (N,): Usenko, Demmel and Cremers, The Double Sphere Camera Model, 3DV 2018."""
    z = xi + np.cos(theta)
    return np.asarray(np.sin(theta) / (alpha * np.hypot(np.sin(theta), z) + (1 - alpha) * z), np.float64)


def extended_unified_radius(alpha: float, beta: float, theta: F64) -> F64:
    """Radius of rays at angles (N,): Khomutenko et al., An Enhanced Unified Camera Model, RA-L 2016."""
    x, z = np.sin(theta), np.cos(theta)
    return np.asarray(x / (alpha * np.sqrt(beta * x * x + z * z) + (1 - alpha) * z), np.float64)


def field_of_view_radius(w: float, theta: F64) -> F64:
    """Radius of rays at angles (N,): Devernay and Faugeras, Straight lines have to be straight, MVA 2001."""
    return np.asarray(np.arctan(2 * np.tan(w / 2) * np.tan(theta)) / w, np.float64)


def max_distorted_radius(width: int, height: int, fx: float, fy: float, cx: float, cy: float) -> float:
    """Largest distorted radius in an image: that of the corner farthest from the principal point."""
    x = np.array([-0.5 - cx, width - 0.5 - cx]) / fx
    y = np.array([-0.5 - cy, height - 0.5 - cy]) / fy
    return float(np.hypot(np.abs(x).max(), np.abs(y).max()))
