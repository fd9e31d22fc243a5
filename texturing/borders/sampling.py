"""Colours that meshes show at places, sampled from their pages as a renderer does, and those wanted instead."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from scan2sim.pipeline.camera.image_sampling import page_colours
from scan2sim.pipeline.core.types import F32, F64, I64
from scan2sim.pipeline.io.images import image
from scan2sim.texturing.borders.correspondences import SOFT, Samples

BLUR = 0.1
"""Share of `reach` by which colours are averaged where more than two tiles meet (a Gaussian's sigma)."""


def colours(samples: Samples, pages: Sequence[Path], places: int) -> F32:
    """(P, 3) grey levels that a mesh shows at the places, as a renderer samples them; NaN where it has no such place.

    Args:
        samples: of the mesh.
        pages: image file of every page; one is in memory at a time.
        places: P.

    Raises:
        InputError: a page can't be read.
    """
    shown = np.empty((len(samples.place), 3), np.float32)
    for k in np.unique(samples.page).tolist():
        here = samples.page == k
        shown[here] = page_colours(image.read_rgb(pages[k]), samples.uv[here])
    return by_place(samples.place, shown, places)


def by_place(place: I64, shown: F32, places: int) -> F32:
    """(P, 3) means of the samples (L, 3) at a place; NaN where there is none."""
    total = np.stack([np.bincount(place, shown[:, k], places) for k in range(3)], axis=1)
    count = np.bincount(place, minlength=places)[:, None]
    return np.divide(total, count, out=np.full((places, 3), np.nan), where=count > 0).astype(np.float32)


def targets(xyz: F64, shown: F32, reach: float) -> F32:
    """(P, 3) the colours that all meshes are to show at places: the mean of those that show them now.

    Where more than two meet, say A, B and C, the mean of A and B along their border leads, over `reach` metres, to
    that of all three: by how much C differs from A and B along its borders with them, close to the corner.

    Args:
        xyz: (P, 3) metres.
        shown: (T, P, 3) grey levels that the meshes show, NaN where they don't have a place.
        reach: metres.
    """
    target, has = np.nanmean(shown, axis=0), np.isfinite(shown[..., 0])
    total, bent = np.zeros(len(xyz)), np.zeros_like(target)
    nearest = np.full(len(xyz), np.inf)
    for corner in np.flatnonzero(has.sum(axis=0) > 2):
        here = has[:, corner]
        distance = np.linalg.norm(xyz - xyz[corner], axis=1)
        mine = (distance < reach) & ~has[~here].any(axis=0)  # all tiles there know all tiles of the corner
        away = _away(shown[here][:, mine], np.exp(-0.5 * (distance[mine] / (reach * BLUR)) ** 2))
        weight = 1 / (distance[mine] ** 2 + SOFT**2) ** 2
        among = has[here][:, mine]
        bent[mine] -= weight[:, None] * ((among / among.sum(axis=0)).T @ away)
        total[mine] += weight
        nearest[mine] = np.minimum(nearest[mine], distance[mine])
    near = np.maximum(0, 1 - nearest / reach)
    share = near**2 * (3 - 2 * near) / np.maximum(total, 1e-12)
    return (target + share[:, None] * bent).astype(np.float32)


def _away(shown: F32, weight: F64) -> F64:
    """(K, 3) how far each of K meshes is from their mean, by the places (K, P, 3) that they share two by two."""
    apart = shown[:, None] - shown[None]
    w = np.where(np.isfinite(apart), weight[:, None], 0)
    return ((w * np.nan_to_num(apart)).sum(axis=2) / np.maximum(w.sum(axis=2), 1e-12)).mean(axis=1)
