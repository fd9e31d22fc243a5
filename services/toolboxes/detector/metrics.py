"""Evaluation of detections: matching with the ground truth, average precision."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scan2sim.pipeline.core.types import F32, I32, Bools
from scan2sim.services.toolboxes.iou import iou_matrix


@dataclass(frozen=True)
class GroundTruth:
    """True boxes of an image: corners (K, 4), classes (K,), and whether each is ignored in the evaluation (K,)."""

    corners: F32
    labels: I32
    ignored: Bools


@dataclass(frozen=True)
class Predictions:
    """Detected boxes of an image: corners (K, 4), scores and classes (K,)."""

    corners: F32
    scores: F32
    labels: I32


def match(found: Predictions, truth: GroundTruth, iou: float = 0.5) -> tuple[I32, Bools]:
    """Greedy matching of predictions with the ground truth, by descending score.

    Returns:
        (K,) index of the matched true box or -1, in the order of the predictions; (K,) whether the prediction is
        excluded from the evaluation, because it matches an ignored box.
    """
    order = np.argsort(-found.scores, kind="stable")
    ious = iou_matrix(found.corners, truth.corners) * (found.labels[:, None] == truth.labels[None])
    matches, excluded = np.full(len(order), -1, np.int32), np.zeros(len(order), bool)
    taken = np.zeros(len(truth.labels), bool)
    for i in order:
        candidates = np.flatnonzero((ious[i] >= iou) & ~taken & ~truth.ignored)
        if len(candidates):
            matches[i] = candidates[ious[i, candidates].argmax()]
            taken[matches[i]] = True
        else:
            excluded[i] = bool(((ious[i] >= iou) & truth.ignored).any())
    return matches, excluded


def average_precision(
    found: Sequence[Predictions], truth: Sequence[GroundTruth], label: int, iou: float = 0.5
) -> float:
    """Area under the precision-recall curve of a class (VOC 2010); NaN if the class has no true boxes.

    Args:
        found, truth: of the same images, in the same order.
    """
    scores, is_true_positive, total = [], [], 0
    for one, true in zip(found, truth, strict=True):
        of_class, true_of_class = one.labels == label, true.labels == label
        predictions = Predictions(one.corners[of_class], one.scores[of_class], one.labels[of_class])
        true_boxes = GroundTruth(true.corners[true_of_class], true.labels[true_of_class], true.ignored[true_of_class])
        matches, excluded = match(predictions, true_boxes, iou)
        scores.append(predictions.scores[~excluded])
        is_true_positive.append(matches[~excluded] >= 0)
        total += int((~true_boxes.ignored).sum())
    if not total:
        return float("nan")
    order = np.argsort(-np.concatenate(scores), kind="stable")
    true_positives = np.cumsum(np.concatenate(is_true_positive)[order])
    recall = np.concatenate([[0.0], true_positives / total])
    precision = np.concatenate([[1.0], true_positives / np.arange(1, len(order) + 1)])
    best = np.maximum.accumulate(precision[::-1])[::-1]
    return float((np.diff(recall) * best[1:]).sum())
