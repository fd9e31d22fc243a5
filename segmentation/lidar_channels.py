"""Channels beside the colours: what a scan measures of each pixel's height, distance and slope.

A picture of them is (h, w, 4) uint8, at a `FRACTION`-th of the pixels that a network looks at:

- height above the ground, of the level that a few metres of it have: kerbs and walls both show (`coded_height`);
- distance, by its logarithm;
- how level the surface is: the upward part of its normal, without sign;
- 255 where the scan has something, else 0 in all four.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from scan2sim.pipeline.core.types import F32, F64, U8

COUNT = 4
FRACTION = 4
CELL = 0.5
"""Metres of the ground's raster."""
LEVELLED = 2.0
"""Metres, standard deviation, over which the ground is levelled: pavements stay above roads, hills don't show."""
NEAR, FAR = 0.5, 120.0
"""Metres between which distances are told apart."""


@dataclass(frozen=True)
class Level:
    """The ground's level: (X, Y) heights, `CELL` apart from `low` (2,) on, local metres."""

    low: F64
    height: F32

    def above(self, xyz: F32) -> F32:
        """(N,) metres of points (N, 3) above it."""
        from scipy.ndimage import map_coordinates

        at = ((xyz[:, :2] - self.low) / CELL - 0.5).T
        return np.asarray(xyz[:, 2] - map_coordinates(self.height, at, order=1, mode="nearest"), np.float32)


def level(ground: F32) -> Level:
    """Of points (N, 3) on the ground: their mean height by cell, levelled; where none is near, that of the nearest."""
    from scipy import ndimage

    low = ground[:, :2].min(axis=0).astype(np.float64)
    cells = ((ground[:, :2] - low) / CELL).astype(np.int64)
    shape = tuple(cells.max(axis=0) + 1)
    flat = np.ravel_multi_index((cells[:, 0], cells[:, 1]), shape)
    count = np.bincount(flat, minlength=shape[0] * shape[1]).reshape(shape)
    total = np.bincount(flat, ground[:, 2], shape[0] * shape[1]).reshape(shape)
    known = (count > 0).astype(np.float64)
    mean = total / np.maximum(count, 1)
    sigma = LEVELLED / CELL
    share = ndimage.gaussian_filter(known, sigma)
    levelled = ndimage.gaussian_filter(mean * known, sigma) / np.maximum(share, 1e-6)
    nearest = ndimage.distance_transform_edt(share < 1e-3, return_distances=False, return_indices=True)
    return Level(low, levelled[tuple(nearest)].astype(np.float32))


def coded_height(metres: F32) -> F32:
    """Code 0 to 255 of heights: 128 the ground's level, steps of 4 mm there and of 70 cm at 16 m."""
    return np.clip(128 + 25 * np.sign(metres) * np.log1p(np.abs(metres) / 0.1), 0, 255)


def coded(height: F32, distance: F32, up: F32) -> U8:
    """(..., 4) codes of height, distance (metres, inf: nothing there) and upward part of the normal."""
    there = np.isfinite(distance) & (distance < FAR)
    far = 255 * np.log(np.clip(distance, NEAR, FAR) / NEAR) / math.log(FAR / NEAR)
    codes = np.stack([coded_height(height), far, 255 * np.abs(up), np.full(far.shape, 255)], axis=-1)
    return np.where(there[..., None], np.nan_to_num(codes) + 0.5, 0).astype(np.uint8)
