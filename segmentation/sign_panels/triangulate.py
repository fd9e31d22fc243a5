"""Signs that photos show: places where several photos agree that a sign hangs, detected by a network's classes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from scan2sim.pipeline.core.types import F32, F64, U8, View
from scan2sim.segmentation.labels import CLASSES

SURE = 127.5
"""Probability, of 255, from which a pixel shows a sign."""
SMALLEST = 3
"""Pixels of a network's picture that a sign covers at least."""
NEAR, FAR, STEPS = 4.0, 60.0, 150
"""Metres between which signs are looked for along a ray, and places there, by equal steps of parallax."""
OTHERS, FARTHER = 2, 1.5
"""Photos that must agree with one, and how much farther away than it they may be to be asked."""
APART = 0.5
"""Metres between two signs: nearer ones are found around one another."""


def hanging(views: Sequence[View], probabilities: Mapping[int, U8]) -> list[F64]:
    """Places (3,), local metres, where signs hang, the surest first.

    Args:
        views: all of them.
        probabilities: index of a view to its probabilities (h, w, C), 255 for 1, by class of `segmentation.labels`.
    """
    shown = {i: np.ascontiguousarray(picture[..., CLASSES.index("road_sign")]) for i, picture in probabilities.items()}
    found = [one for i in shown for ray in _rays(views[i], shown[i]) if (one := _along(ray, i, views, shown))]
    places: list[F64] = []
    for _, place in sorted(found, key=lambda one: -one[0]):
        if all(np.linalg.norm(place - other) > APART for other in places):
            places.append(place)
    return places


def _rays(view: View, sign: U8) -> list[F64]:
    """Unit rays (3,), local axes, through the middles of what a photo shows as signs."""
    from scipy import ndimage

    from scan2sim.pipeline.camera.models import unproject

    part, count = ndimage.label(sign > SURE)
    large = [k for k in range(1, count + 1) if (part == k).sum() >= SMALLEST]
    if not large:
        return []
    middle = np.array(ndimage.center_of_mass(sign, part, large))[:, ::-1]
    scale = np.array([view.camera.width / sign.shape[1], view.camera.height / sign.shape[0]])
    rays = unproject(view.camera, (middle + 0.5) * scale - 0.5) @ view.T_world_cam[:3, :3].T
    return [ray for ray in rays if np.isfinite(ray).all()]


def _along(ray: F64, own: int, views: Sequence[View], shown: Mapping[int, U8]) -> tuple[float, F64] | None:
    """The place along a photo's ray that most others show as a sign, after how surely; None where too few do."""
    distance = 1 / np.linspace(1 / NEAR, 1 / FAR, STEPS)
    places = views[own].centre + distance[:, None] * ray
    votes, seeing = np.zeros(STEPS), np.zeros(STEPS)
    for j, sign in shown.items():
        if j != own:
            probability = _sampled(views[j], sign, places)
            near = np.linalg.norm(places - views[j].centre, axis=1) < FARTHER * distance
            counts = np.isfinite(probability) & near
            votes += np.where(counts, probability > SURE, 0)
            seeing += counts
    share = np.where(votes >= OTHERS, votes / np.maximum(seeing, 1), 0)
    best = np.flatnonzero(share == share.max())
    return (float(share.max()), places[best[len(best) // 2]]) if share.max() > 0.5 else None


def _sampled(view: View, sign: U8, places: F64) -> F32:
    """(N,) how surely a photo shows a sign at places (N, 3), of 255; NaN where it doesn't show them."""
    from scan2sim.pipeline.camera.projection import pixels

    uv, valid = pixels(view.camera, view.T_world_cam, places)
    uv = np.where(valid[:, None], uv, 0)
    column = ((uv[:, 0] + 0.5) * sign.shape[1] / view.camera.width).astype(int).clip(0, sign.shape[1] - 1)
    row = ((uv[:, 1] + 0.5) * sign.shape[0] / view.camera.height).astype(int).clip(0, sign.shape[0] - 1)
    return np.where(valid, sign[row, column], np.nan).astype(np.float32)
