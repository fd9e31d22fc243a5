"""Background beyond the street: sky, hills at the horizon, and the plain in between; compiled."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from scan2sim.data_samples.materials import noise


@njit(cache=True, parallel=True)
def beyond(
    origins: npt.NDArray[Any], directions: npt.NDArray[Any], sun: npt.NDArray[Any], cloudiness: float,
    axis: npt.NDArray[Any], ends: npt.NDArray[Any], seed: int,
) -> npt.NDArray[Any]:  # fmt: skip
    """(N, 3) float32 linear light of rays that leave the street.

    Args:
        origins, directions: (N, 3) local metres, and unit vectors.
        sun: (3,) unit vector towards the sun.
        cloudiness: share of clouds.
        axis: the road's heading, curvature, and half width.
        ends: (2,) height of the ground at the road's start and end, from where the road continues on a plain.
        seed: seed of hills and clouds.
    """
    n = len(directions)
    light = np.empty((n, 3), np.float32)
    heading, curvature, half = axis[0], axis[1], axis[2]
    for i in prange(n):
        x, y, z = float(directions[i, 0]), float(directions[i, 1]), float(directions[i, 2])
        azimuth = math.atan2(y, x)
        cx, cy = 9 * math.cos(azimuth), 9 * math.sin(azimuth)
        hills = 0.055 + 0.035 * noise(cx, cy, 3.1, 0.0, seed) + 0.012 * noise(cx, cy, 0.8, 0.0, seed + 1)
        trees = 0.022 + 0.016 * noise(cx, cy, 0.5, 0.0, seed + 2) + 0.008 * noise(cx, cy, 0.11, 0.0, seed + 3)
        up = max(z, 0.0)
        near = x * sun[0] + y * sun[1] + z * sun[2]
        glow = max(near, 0.0)
        glow = 0.10 * glow**6 + 0.25 * glow**60
        haze = math.exp(-5.0 * up)
        r = 0.16 + 0.44 * haze + glow
        g = 0.32 + 0.36 * haze + 0.95 * glow
        b = 0.66 + 0.16 * haze + 0.8 * glow
        if z > 0.02:  # clouds, on a horizontal plane
            u, v = x / (z + 0.08), y / (z + 0.08)
            w = (
                noise(u, v, 1.9, 0.0, seed + 4)
                + 0.55 * noise(u, v, 0.8, 0.0, seed + 5)
                + 0.3 * noise(u, v, 0.33, 0.0, seed + 6)
            )
            w += 0.16 * noise(u, v, 0.14, 0.0, seed + 7) + 0.08 * noise(u, v, 0.06, 0.0, seed + 8)
            cover = min(max((w + 1.9 * cloudiness - 1.05) * 1.3, 0.0), 0.92) * min(z * 9.0, 1.0)
            white = 0.93 - 0.16 * min(max(w, 0.0), 1.0)
            r, g, b = r + (white - r) * cover, g + (0.99 * white - g) * cover, b + (1.02 * white - b) * cover
        if z < hills:
            blend = min((hills - z) / 0.003, 1.0)
            f = 1 + 0.12 * noise(cx * 3, z * 60, 1.0, 0.0, seed + 9)
            r, g, b = r + (0.27 * f - r) * blend, g + (0.36 * f - g) * blend, b + (0.42 * f - b) * blend
        if z < trees:
            blend = min((trees - z) / 0.002, 1.0)
            f = 1 + 0.3 * noise(cx * 6, z * 150, 1.0, 0.0, seed + 10)
            r, g, b = r + (0.12 * f - r) * blend, g + (0.17 * f - g) * blend, b + (0.10 * f - b) * blend
        if z < -0.004:
            ox, oy, oz = float(origins[i, 0]), float(origins[i, 1]), float(origins[i, 2])
            ahead = x * math.cos(heading) + y * math.sin(heading) > 0
            far = max(oz - (ends[1] if ahead else ends[0]), 0.3) / -z
            px, py = ox + far * x, oy + far * y
            radius = 1 / curvature
            dx, dy = px + radius * math.sin(heading), py - radius * math.cos(heading)
            t = radius - math.copysign(math.hypot(dx, dy), radius)
            w = 0.01 + far * 0.002 / max(-z, 0.05) * 0.3
            f = 1 + 0.25 * noise(px, py, 0.5, w, seed + 11) + 0.25 * noise(px, py, 4.0, w, seed + 12)
            r1, g1, b1 = 0.135 * f, 0.20 * f, 0.065 * f
            if abs(t) < half:
                f = 1 + 0.12 * noise(px, py, 0.12, w, seed + 13)
                r1 = g1 = b1 = 0.17 * f
                if abs(abs(t) - half + 0.2) < 0.06:
                    r1 = g1 = b1 = 0.5
            elif abs(t) < half + 2.3:
                r1, g1, b1 = 0.40, 0.39, 0.36
            mist = 1 - math.exp(-far / 260.0)
            r, g, b = r1 + (0.34 - r1) * mist, g1 + (0.42 - g1) * mist, b1 + (0.42 - b1) * mist
        light[i, 0], light[i, 1], light[i, 2] = r, g, b
    return light
