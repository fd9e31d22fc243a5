"""How well boxes that were found fit those that are known: average precision, and what of each size was found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scan2sim.pipeline.core.types import F32, I32, Bools
from scan2sim.services.toolboxes.iou import overlaps


@dataclass(frozen=True)
class Truth:
    """Known boxes of a picture: corners (K, 4), classes (K,), and which of them may be found or not (K,)."""

    corners: F32
    labels: I32
    spared: Bools


@dataclass(frozen=True)
class Found:
    """Boxes that were found in a picture: corners (K, 4), scores and classes (K,)."""

    corners: F32
    scores: F32
    labels: I32


def matched(found: Found, truth: Truth, iou: float = 0.5) -> tuple[I32, Bools]:
    """Which known box each found one, best first, is the first to hit, and which found ones don't count.

    Returns:
        (K,) index into the truth or -1, in order of the found boxes; (K,) whether it hit one that is spared.
    """
    order = np.argsort(-found.scores, kind="stable")
    both = overlaps(found.corners, truth.corners) * (found.labels[:, None] == truth.labels[None])
    hit, left_out = np.full(len(order), -1, np.int32), np.zeros(len(order), bool)
    taken = np.zeros(len(truth.labels), bool)
    for i in order:
        fits = np.flatnonzero((both[i] >= iou) & ~taken & ~truth.spared)
        if len(fits):
            hit[i] = fits[both[i, fits].argmax()]
            taken[hit[i]] = True
        else:
            left_out[i] = bool(((both[i] >= iou) & truth.spared).any())
    return hit, left_out


def average_precision(found: Sequence[Found], truth: Sequence[Truth], label: int, iou: float = 0.5) -> float:
    """Area under the curve of precision over recall of a class (VOC 2010), NaN where there is none.

    Args:
        found, truth: of the same pictures.
    """
    scores, right, known = [], [], 0
    for one, true in zip(found, truth, strict=True):
        own, there = one.labels == label, true.labels == label
        mine = Found(one.corners[own], one.scores[own], one.labels[own])
        hit, left_out = matched(mine, Truth(true.corners[there], true.labels[there], true.spared[there]), iou)
        scores.append(mine.scores[~left_out])
        right.append(hit[~left_out] >= 0)
        known += int((~true.spared[there]).sum())
    if not known:
        return float("nan")
    order = np.argsort(-np.concatenate(scores), kind="stable")
    true_ones = np.cumsum(np.concatenate(right)[order])
    recall = np.concatenate([[0.0], true_ones / known])
    precision = np.concatenate([[1.0], true_ones / np.arange(1, len(order) + 1)])
    best = np.maximum.accumulate(precision[::-1])[::-1]
    return float((np.diff(recall) * best[1:]).sum())
