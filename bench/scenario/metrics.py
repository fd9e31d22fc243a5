"""Metrics of tracking: MOTA (Bernardin and Stiefelhagen, 2008) and HOTA (Luiten et al., IJCV 2021)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from scan2sim.pipeline.core.types import F64, I64

ALPHAS = np.arange(0.05, 0.99, 0.05)
"""Thresholds of similarity over which HOTA is averaged."""
EPSILON = np.finfo(np.float64).eps


@dataclass(frozen=True)
class Frame:
    """Boxes of a frame.

    Attributes:
        truth: (N,) identities of the true objects.
        found: (M,) identities of tracks.
        similarity: (N, M) 0 to 1, intersection over union of their boxes.
    """

    truth: I64
    found: I64
    similarity: F64


@dataclass(frozen=True)
class Clear:
    """CLEAR metrics: `mota`, and numbers of true boxes, of missed ones, of false positives and identity switches."""

    mota: float
    truth: int
    missed: int
    false: int
    switches: int


def clear(frames: Sequence[Frame], threshold: float = 0.5) -> Clear:
    """CLEAR metrics at a threshold of similarity; a match of the frame before is kept where it still holds."""
    last: dict[int, int] = {}
    total = missed = false = switches = 0
    before: dict[int, int] = {}
    for frame in frames:
        total += len(frame.truth)
        if not (len(frame.truth) and len(frame.found)):
            missed += len(frame.truth)
            false += len(frame.found)
            continue
        kept = np.array([[before.get(int(t)) == int(f) for f in frame.found] for t in frame.truth])
        score = np.where(
            frame.similarity >= threshold - EPSILON, frame.similarity + 1000 * kept.reshape(frame.similarity.shape), 0
        )
        rows, columns = linear_sum_assignment(-score)
        matched = score[rows, columns] > 0
        before = {}
        for row, column in zip(rows[matched], columns[matched], strict=True):
            true, found = int(frame.truth[row]), int(frame.found[column])
            switches += last.get(true, found) != found
            last[true] = before[true] = found
        missed += len(frame.truth) - len(before)
        false += len(frame.found) - len(before)
    return Clear(1 - (missed + false + switches) / max(total, 1), total, missed, false, switches)


def hota(frames: Sequence[Frame]) -> float:
    """HOTA: geometric mean of the accuracies of detection and association, averaged over `ALPHAS`."""
    truth_ids = _numbers([frame.truth for frame in frames])
    found_ids = _numbers([frame.found for frame in frames])
    shape = len(truth_ids), len(found_ids)
    if not all(shape):
        return 0.0
    potential, truth_count, found_count = np.zeros(shape), np.zeros((shape[0], 1)), np.zeros((1, shape[1]))
    rows = [np.array([truth_ids[int(i)] for i in frame.truth], np.int64) for frame in frames]
    columns = [np.array([found_ids[int(i)] for i in frame.found], np.int64) for frame in frames]
    for frame, row, column in zip(frames, rows, columns, strict=True):
        both = frame.similarity.sum(axis=0) + frame.similarity.sum(axis=1, keepdims=True) - frame.similarity
        potential[np.ix_(row, column)] += frame.similarity / np.maximum(both, EPSILON)
        truth_count[row] += 1
        found_count[0, column] += 1
    alignment = potential / (truth_count + found_count - potential)
    matches = np.zeros((len(ALPHAS), *shape))
    for frame, row, column in zip(frames, rows, columns, strict=True):
        a, b = linear_sum_assignment(-alignment[np.ix_(row, column)] * frame.similarity)
        for k, alpha in enumerate(ALPHAS):
            good = frame.similarity[a, b] >= alpha - EPSILON
            matches[k, row[a[good]], column[b[good]]] += 1
    hits = matches.sum(axis=(1, 2))
    detection = hits / np.maximum(truth_count.sum() + found_count.sum() - hits, 1)
    association = (matches**2 / np.maximum(truth_count + found_count - matches, 1)).sum(axis=(1, 2)) / np.maximum(
        hits, 1
    )
    return float(np.sqrt(detection * association).mean())


def _numbers(ids: Sequence[I64]) -> dict[int, int]:
    return {int(one): k for k, one in enumerate(np.unique(np.concatenate([np.zeros(0, np.int64), *ids])))}


def check() -> None:
    """Hand-worked cases of both metrics; they also agree with TrackEval 1.3 on random tracks."""
    one, none = np.array([1]), np.zeros(0, np.int64)
    good, bad = np.array([[0.8]]), np.array([[0.3]])
    # two frames found, one missed, one with a false box beside the miss, one with another identity
    frames = [
        Frame(one, np.array([7]), good), Frame(one, np.array([7]), good), Frame(one, none, np.zeros((1, 0))),
        Frame(one, np.array([7]), bad), Frame(one, np.array([8]), good),
    ]  # fmt: skip
    assert clear(frames) == Clear(1 - (2 + 1 + 1) / 5, 5, 2, 1, 1)
    # one object in four frames, found in two of them with a similarity of 1: DetA 2 / 4, AssA 2 / 4
    half = [Frame(one, np.array([7]), np.ones((1, 1)))] * 2 + [Frame(one, none, np.zeros((1, 0)))] * 2
    assert abs(hota(half) - 0.5) < 1e-12
    # found in all four, by two identities: DetA 1, AssA 2 / 4
    swapped = [Frame(one, np.array([7 + k // 2]), np.ones((1, 1))) for k in range(4)]
    assert abs(hota(swapped) - np.sqrt(0.5)) < 1e-12
