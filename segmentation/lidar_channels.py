"""Lidar channels of a network's input: height, distance and slope of each pixel, measured by a scan.

An image of them is (h, w, 4) uint8, at 1/`DOWNSAMPLING` of the resolution at which a network classifies a photo:

- height above the ground level, averaged over a few metres, so that both kerbs and walls show (`encode_height`);
- logarithm of the distance;
- slope of the surface: |z| of its normal;
- validity: 255 where the scan has a point; elsewhere all four are 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from scan2sim.pipeline.core.types import F32, F64, U8

CHANNELS = 4
DOWNSAMPLING = 4
GROUND_CELL_M = 0.5
"""Cell size of the ground level's grid."""
GROUND_SIGMA_M = 2.0
"""Sigma of the Gaussian that smooths the ground level: pavements stay above roads, hills don't show."""
MIN_DISTANCE_M, MAX_DISTANCE_M = 0.5, 120.0
"""Range of encoded distances."""


@dataclass(frozen=True)
class GroundLevel:
    """Smoothed ground level: (X, Y) heights on a grid of `GROUND_CELL_M` from `low` (2,), local metres."""

    low: F64
    height: F32

    def above(self, xyz: F32) -> F32:
        """(N,) heights of points (N, 3) above the ground level in metres."""
        from scipy.ndimage import map_coordinates

        at = ((xyz[:, :2] - self.low) / GROUND_CELL_M - 0.5).T
        return np.asarray(xyz[:, 2] - map_coordinates(self.height, at, order=1, mode="nearest"), np.float32)


def ground_level(ground: F32) -> GroundLevel:
    """Ground level of ground points (N, 3): smoothed mean height per cell, extrapolated from the nearest cell."""
    from scipy import ndimage

    low = ground[:, :2].min(axis=0).astype(np.float64)
    cells = ((ground[:, :2] - low) / GROUND_CELL_M).astype(np.int64)
    shape = tuple(cells.max(axis=0) + 1)
    flat = np.ravel_multi_index((cells[:, 0], cells[:, 1]), shape)
    count = np.bincount(flat, minlength=shape[0] * shape[1]).reshape(shape)
    total = np.bincount(flat, ground[:, 2], shape[0] * shape[1]).reshape(shape)
    known = (count > 0).astype(np.float64)
    mean = total / np.maximum(count, 1)
    sigma = GROUND_SIGMA_M / GROUND_CELL_M
    share = ndimage.gaussian_filter(known, sigma)
    smoothed = ndimage.gaussian_filter(mean * known, sigma) / np.maximum(share, 1e-6)
    nearest = ndimage.distance_transform_edt(share < 1e-3, return_distances=False, return_indices=True)
    return GroundLevel(low, smoothed[tuple(nearest)].astype(np.float32))


def encode_height(metres: F32) -> F32:
    """Codes 0 to 255 of heights: 128 at ground level; resolution 4 mm there and 70 cm at 16 m."""
    return np.clip(128 + 25 * np.sign(metres) * np.log1p(np.abs(metres) / 0.1), 0, 255)


def encode(height: F32, distance: F32, up: F32) -> U8:
    """(..., 4) codes of height and distance (metres, inf: no point) and of |z| of the normal."""
    valid = np.isfinite(distance) & (distance < MAX_DISTANCE_M)
    far = (
        255
        * np.log(np.clip(distance, MIN_DISTANCE_M, MAX_DISTANCE_M) / MIN_DISTANCE_M)
        / math.log(MAX_DISTANCE_M / MIN_DISTANCE_M)
    )
    codes = np.stack([encode_height(height), far, 255 * np.abs(up), np.full(far.shape, 255)], axis=-1)
    return np.where(valid[..., None], np.nan_to_num(codes) + 0.5, 0).astype(np.uint8)
