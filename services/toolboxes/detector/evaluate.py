"""Precision and recall of a detector's vehicles on labelled photos, and the threshold for a wanted precision."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.types import F32, U8, Bools
from scan2sim.services.toolboxes.detector.dataset import MIN_VISIBLE_SHARE, read, read_image
from scan2sim.services.toolboxes.detector.metrics import GroundTruth, Predictions, match
from scan2sim.services.toolboxes.results import Body

VEHICLES = ("car", "van", "bus", "truck")
MIN_HEIGHT_PX = 25.0
"""Smaller vehicles are ignored: KITTI's limit."""
WANTED_PRECISION = 0.8
MIN_SCORE = 0.1
"""Lowest score that is evaluated."""
IGNORED_SHARE = 0.5
"""Share of a detection in ignored regions from which it is ignored."""


@dataclass(frozen=True)
class Figures:
    """Vehicles at a threshold: recall and precision, the score from which the precision is as wanted, and the number.

    Attributes:
        recall, precision: at `threshold`.
        threshold: lowest score from which the precision is at least the wanted one.
        vehicles: number of true vehicles.
    """

    recall: float
    precision: float
    threshold: float
    vehicles: int


def vehicle_predictions(body: Body) -> Predictions:
    """The vehicles among detections, as one class."""
    own = [one for one in body.detections or () if one.label in VEHICLES]
    corners = np.array([one.box for one in own], np.float32).reshape(-1, 4)
    return Predictions(corners, np.array([one.score for one in own], np.float32), np.zeros(len(own), np.int32))


def curve(found: Sequence[Predictions], truth: Sequence[GroundTruth]) -> tuple[F32, Bools, int]:
    """Scores of detections by descending order, whether each is right, and the number of true boxes.

    Args:
        found, truth: of the same images; detections in ignored regions don't count.
    """
    scores, right, total = [], [], 0
    for one, true in zip(found, truth, strict=True):
        matches, excluded = match(one, true)
        counts = ~excluded & ((matches >= 0) | (covered_share(one.corners, true.corners[true.ignored]) < IGNORED_SHARE))
        scores.append(one.scores[counts])
        right.append(matches[counts] >= 0)
        total += int((~true.ignored).sum())
    order = np.argsort(-np.concatenate(scores), kind="stable")
    return np.concatenate(scores)[order], np.concatenate(right)[order], total


def at_precision(
    found: Sequence[Predictions], truth: Sequence[GroundTruth], wanted: float = WANTED_PRECISION
) -> Figures:
    """Figures at the lowest threshold from which precision is at least the wanted one; recall 0 if it never is."""
    scores, right, total = curve(found, truth)
    precision = np.cumsum(right) / np.arange(1, len(right) + 1)
    enough = np.flatnonzero(precision >= wanted)
    if not len(enough) or not total:
        return Figures(0.0, 0.0, 1.0, total)
    k = int(enough[-1])
    return Figures(float(right[: k + 1].sum() / total), float(precision[k]), float(scores[k]), total)


def covered_share(corners: F32, regions: F32) -> F32:
    """(K,) share of boxes (K, 4) that lies in regions (R, 4), which don't overlap each other."""
    low = np.maximum(corners[:, None, :2], regions[None, :, :2])
    high = np.minimum(corners[:, None, 2:], regions[None, :, 2:])
    common = np.clip(high - low, 0, None).prod(axis=2).sum(axis=1)
    area = (corners[:, 2:] - corners[:, :2]).prod(axis=1)
    return np.asarray(common / np.maximum(area, 1e-6), np.float32)


def vehicles_in(
    folder: Path, model: Callable[[Sequence[U8]], list[Body]]
) -> tuple[list[Predictions], list[GroundTruth]]:
    """Detected and true vehicles of a dataset's photos, as one class.

    Args:
        folder: the dataset.
        model: a detector that reports boxes from `MIN_SCORE` on.

    Raises:
        DataError: the dataset is invalid.
    """
    images, names = read(folder)
    vehicles = [names.index(name) for name in VEHICLES]
    found, truth = [], []
    for one in images:
        (body,) = model([read_image(one.image)])
        found.append(vehicle_predictions(body))
        own = np.isin(one.classes, vehicles)
        boxes = one.boxes[own]
        ignored = (one.visible[own] < MIN_VISIBLE_SHARE) | (boxes[:, 3] - boxes[:, 1] < MIN_HEIGHT_PX)
        truth.append(GroundTruth(boxes, np.zeros(len(boxes), np.int32), ignored))
    return found, truth
