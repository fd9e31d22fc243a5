"""Triangulation of signs: 3D positions at which several photos agree on a sign, from a network's classes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from scan2sim.pipeline.core.types import F32, F64, U8, View
from scan2sim.segmentation.labels import CLASSES

DETECTION_THRESHOLD = 127.5
"""Probability (of 255) from which a pixel shows a sign."""
MIN_PIXELS = 3
"""Smallest number of pixels of a sign in a network's output."""
MIN_DISTANCE_M, MAX_DISTANCE_M, SAMPLES_PER_RAY = 4.0, 60.0, 150
"""Range in which signs are searched along a ray, and samples there, with equal steps of parallax."""
MIN_AGREEING_PHOTOS, MAX_DISTANCE_RATIO = 2, 1.5
"""Number of other photos that must agree, and their largest distance relative to the first photo's."""
MIN_SEPARATION_M = 0.5
"""Distance between two signs: nearer ones are found when panels are fitted around one of them."""


def triangulate_signs(views: Sequence[View], probabilities: Mapping[int, U8]) -> list[F64]:
    """Positions (3,) of signs in local metres, the most certain first.

    Args:
        views: all views.
        probabilities: index of a view to its probabilities (h, w, C), 255 for 1, by class of `segmentation.labels`.
    """
    signs = {i: np.ascontiguousarray(classes[..., CLASSES.index("road_sign")]) for i, classes in probabilities.items()}
    found = [
        detection for i in signs for ray in _rays(views[i], signs[i]) if (detection := _along(ray, i, views, signs))
    ]
    positions: list[F64] = []
    for _, position in sorted(found, key=lambda detection: -detection[0]):
        if all(np.linalg.norm(position - other) > MIN_SEPARATION_M for other in positions):
            positions.append(position)
    return positions


def _rays(view: View, sign: U8) -> list[F64]:
    """Unit rays (3,), local axes, through the centres of the signs detected in a photo."""
    from scipy import ndimage

    from scan2sim.pipeline.camera.models import unproject

    part, count = ndimage.label(sign > DETECTION_THRESHOLD)
    large = [k for k in range(1, count + 1) if (part == k).sum() >= MIN_PIXELS]
    if not large:
        return []
    middle = np.array(ndimage.center_of_mass(sign, part, large))[:, ::-1]
    scale = np.array([view.camera.width / sign.shape[1], view.camera.height / sign.shape[0]])
    rays = unproject(view.camera, (middle + 0.5) * scale - 0.5) @ view.T_world_cam[:3, :3].T
    return [ray for ray in rays if np.isfinite(ray).all()]


def _along(ray: F64, own: int, views: Sequence[View], signs: Mapping[int, U8]) -> tuple[float, F64] | None:
    """Score, and the point along a photo's ray at which most other photos show a sign; None if too few do."""
    distance = 1 / np.linspace(1 / MIN_DISTANCE_M, 1 / MAX_DISTANCE_M, SAMPLES_PER_RAY)
    points = views[own].centre + distance[:, None] * ray
    votes, observations = np.zeros(SAMPLES_PER_RAY), np.zeros(SAMPLES_PER_RAY)
    for j, sign in signs.items():
        if j != own:
            probability = _probability_at(views[j], sign, points)
            near = np.linalg.norm(points - views[j].centre, axis=1) < MAX_DISTANCE_RATIO * distance
            observed = np.isfinite(probability) & near
            votes += np.where(observed, probability > DETECTION_THRESHOLD, 0)
            observations += observed
    share = np.where(votes >= MIN_AGREEING_PHOTOS, votes / np.maximum(observations, 1), 0)
    best = np.flatnonzero(share == share.max())
    return (float(share.max()), points[best[len(best) // 2]]) if share.max() > 0.5 else None


def _probability_at(view: View, sign: U8, points: F64) -> F32:
    """(N,) probability (of 255) of a sign in a photo at points (N, 3); NaN outside the photo."""
    from scan2sim.pipeline.camera.projection import pixels

    uv, valid = pixels(view.camera, view.T_world_cam, points)
    uv = np.where(valid[:, None], uv, 0)
    column = ((uv[:, 0] + 0.5) * sign.shape[1] / view.camera.width).astype(int).clip(0, sign.shape[1] - 1)
    row = ((uv[:, 1] + 0.5) * sign.shape[0] / view.camera.height).astype(int).clip(0, sign.shape[0] - 1)
    return np.where(valid, sign[row, column], np.nan).astype(np.float32)
