"""Colours of textured meshes at border points, sampled as a renderer does, and their target colours."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from scan2sim.pipeline.camera.image_sampling import page_colours
from scan2sim.pipeline.core.types import F32, F64, I64
from scan2sim.pipeline.io.images import image
from scan2sim.texturing.borders.correspondences import SOFTENING_M, Samples

CORNER_SIGMA_SHARE = 0.1
"""Sigma of the Gaussian by which colours are averaged around tile corners, as a share of `fade_distance`."""


def colours(samples: Samples, pages: Sequence[Path], points: int) -> F32:
    """(P, 3) grey levels of a mesh at the border points, sampled as a renderer does; NaN at points of other meshes.

    Args:
        samples: samples of the mesh.
        pages: image file of every page; one is in memory at a time.
        points: number of border points, P.

    Raises:
        InputError: a page can't be read.
    """
    sampled = np.empty((len(samples.point), 3), np.float32)
    for k in np.unique(samples.page).tolist():
        on_page = samples.page == k
        sampled[on_page] = page_colours(image.read_rgb(pages[k]), samples.uv[on_page])
    return mean_by_point(samples.point, sampled, points)


def mean_by_point(point: I64, sampled: F32, points: int) -> F32:
    """(P, 3) mean of the samples (L, 3) at each point; NaN where there is none."""
    total = np.stack([np.bincount(point, sampled[:, k], points) for k in range(3)], axis=1)
    count = np.bincount(point, minlength=points)[:, None]
    return np.divide(total, count, out=np.full((points, 3), np.nan), where=count > 0).astype(np.float32)


def targets(xyz: F64, current: F32, fade_distance: float) -> F32:
    """(P, 3) target colours of all meshes at the border points: the mean of their current colours.

    Around corners of more than two tiles, say A, B and C, the mean of A and B along their border blends, over
    `fade_distance` metres, into the mean of all three, using the mean difference of C to A and B along their borders
    near the corner.

    Args:
        xyz: (P, 3) border points, metres.
        current: (T, P, 3) grey levels of the meshes, NaN at points that they don't have.
        fade_distance: blending distance in metres.
    """
    target, has = np.nanmean(current, axis=0), np.isfinite(current[..., 0])
    total, correction = np.zeros(len(xyz)), np.zeros_like(target)
    nearest = np.full(len(xyz), np.inf)
    for corner in np.flatnonzero(has.sum(axis=0) > 2):
        meets = has[:, corner]
        distance = np.linalg.norm(xyz - xyz[corner], axis=1)
        near_corner = (distance < fade_distance) & ~has[~meets].any(
            axis=0
        )  # only between tiles that meet at the corner
        gaussian = np.exp(-0.5 * (distance[near_corner] / (fade_distance * CORNER_SIGMA_SHARE)) ** 2)
        deviation = _deviations(current[meets][:, near_corner], gaussian)
        weight = 1 / (distance[near_corner] ** 2 + SOFTENING_M**2) ** 2
        sharing = has[meets][:, near_corner]
        correction[near_corner] -= weight[:, None] * ((sharing / sharing.sum(axis=0)).T @ deviation)
        total[near_corner] += weight
        nearest[near_corner] = np.minimum(nearest[near_corner], distance[near_corner])
    near = np.maximum(0, 1 - nearest / fade_distance)
    share = near**2 * (3 - 2 * near) / np.maximum(total, 1e-12)
    return (target + share[:, None] * correction).astype(np.float32)


def _deviations(current: F32, weight: F64) -> F64:
    """(K, 3) deviation of each of K meshes from their mean, from points (K, P, 3) that pairs of them share."""
    difference = current[:, None] - current[None]
    w = np.where(np.isfinite(difference), weight[:, None], 0)
    return ((w * np.nan_to_num(difference)).sum(axis=2) / np.maximum(w.sum(axis=2), 1e-12)).mean(axis=1)
