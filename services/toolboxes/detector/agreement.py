"""Agreement of detections in encoded images with those in the original images: what accuracy an encoding costs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scan2sim.services.toolboxes.detector.metrics import GroundTruth, Predictions, match
from scan2sim.services.toolboxes.results import Body

MIN_SCORE = 0.3
"""Detections below it are ignored."""


def agreement(found: Sequence[Predictions], original: Sequence[Predictions], min_score: float = MIN_SCORE) -> float:
    """F1 of confident detections relative to those in the original images; NaN if there are none in either."""
    right, total = 0, 0
    for one, before in zip(found, original, strict=True):
        sure, known = _confident(one, min_score), _confident(before, min_score)
        hit, _ = match(sure, GroundTruth(known.corners, known.labels, np.zeros(len(known.labels), bool)))
        right, total = right + int((hit >= 0).sum()), total + len(sure.labels) + len(known.labels)
    return 2 * right / total if total else float("nan")


def _confident(found: Predictions, min_score: float) -> Predictions:
    sure = found.scores >= min_score
    return Predictions(found.corners[sure], found.scores[sure], found.labels[sure])


def predictions(bodies: Sequence[Body], names: Sequence[str], scale: float = 1.0) -> list[Predictions]:
    """Detections of a toolbox, with boxes at the size that `scale` has reduced; `names`: the model's classes."""
    return [
        Predictions(
            np.array([one.box for one in body.detections or ()], np.float32).reshape(-1, 4) / np.float32(scale),
            np.array([one.score for one in body.detections or ()], np.float32),
            np.array([names.index(one.label) for one in body.detections or ()], np.int32),
        )
        for body in bodies
    ]
