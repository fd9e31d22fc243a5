"""Depth of every pixel of the photos: of the scan, of consistent stereo, or of the nearest pixel that has one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scan2sim.pipeline.core.types import F32, Bools
from scan2sim.texturing.backdrop.photos import FARTHEST_M, Photo

ABSOLUTE_TOLERANCE, RELATIVE_TOLERANCE = 0.004, 0.04
"""Differences of inverse depths (1/m, and relative) up to which two photos agree."""
MEDIAN_PX = 5
JITTER = 0.06
"""Relative deviation by which guessed depths are spread, so that several photos' guesses don't form a wrong surface."""


def inverse_depths(photos: Sequence[Photo], near: Sequence[Sequence[int]], seed: int = 0) -> list[F32]:
    """Inverse distances (H, W) along the rays of each photo, 1/metres; below 1 / `FARTHEST_M` is the background.

    Args:
        photos: with `inverse` by `plane_sweep`.
        near: indices of the photos that each is compared with.
        seed: of the jitter.
    """
    return [
        _completed(photo, consistent(photo, [photos[j] for j in near[i]]), np.random.default_rng((seed, i)))
        for i, photo in enumerate(photos)
    ]


def consistent(photo: Photo, others: Sequence[Photo]) -> Bools:
    """(H, W) pixels whose depth was scanned, or is confirmed by another photo's depth there."""
    from scan2sim.pipeline.camera.projection import pixels

    own = _known_or_estimated(photo)
    good: Bools = np.isfinite(photo.known)
    open_ = ~good & (own > 1 / FARTHEST_M)
    points = photo.view.centre + photo.rays[open_] / own[open_][:, None]
    agrees = np.zeros(len(points), bool)
    for other in others:
        uv, inside = pixels(other.camera, other.view.T_world_cam, points)
        height, width = other.known.shape
        column = np.clip(np.rint(uv[:, 0]), 0, width - 1).astype(int)
        row = np.clip(np.rint(uv[:, 1]), 0, height - 1).astype(int)
        there = _known_or_estimated(other)[row, column]
        expected = 1 / np.maximum(np.linalg.norm(points - other.view.centre, axis=1), 1e-3)
        agrees |= inside & (np.abs(there - expected) < ABSOLUTE_TOLERANCE + RELATIVE_TOLERANCE * there)
    good = good.copy()
    good[open_] = agrees
    return good


def _known_or_estimated(photo: Photo) -> F32:
    return np.where(np.isfinite(photo.known), 1 / np.maximum(photo.known, 1e-3), photo.inverse).astype(np.float32)


def _completed(photo: Photo, good: Bools, random: np.random.Generator) -> F32:
    """Inverse depth with that of the nearest good pixel where it isn't good, unless it is far."""
    import cv2

    own = _known_or_estimated(photo)
    guessed = ~good & (own > 1 / FARTHEST_M)
    if not good.any() or not guessed.any():
        return own
    _, nearest = cv2.distanceTransformWithLabels(
        (~good).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    value_of = np.zeros(int(nearest.max()) + 1, np.float32)
    value_of[nearest[good]] = own[good]
    filled = np.asarray(cv2.medianBlur(value_of[nearest], MEDIAN_PX), np.float32)
    spread = 1 + random.uniform(-JITTER, JITTER, own.shape).astype(np.float32)
    return np.where(guessed, filled * spread, own).astype(np.float32)
