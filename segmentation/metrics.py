"""Evaluation of predicted classes against ground truth: confusion matrix and intersection over union (IoU)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2sim.pipeline.core.classes import CLASSES, CODE, UNKNOWN
from scan2sim.pipeline.core.types import I64, U8

MEAN_OF = ("road", "terrain", "building", "low_vegetation", "high_vegetation")
"""Classes over which the mean intersection over union is taken."""


@dataclass(frozen=True)
class Confusion:
    """Confusion matrix.

    Attributes:
        codes: (K,) LAS codes that occur.
        count: (K, K) number of points; rows: true class, columns: predicted class.
    """

    codes: tuple[int, ...]
    count: I64

    @property
    def iou(self) -> dict[str, float]:
        """Intersection over union of every class that occurs in the ground truth, by name."""
        names = {c.code: c.name for c in CLASSES}
        both = np.diag(self.count)
        either = self.count.sum(axis=0) + self.count.sum(axis=1) - both
        return {
            names.get(code, str(code)): float(both[k] / either[k])
            for k, code in enumerate(self.codes)
            if self.count[k].any()
        }

    def mean(self, classes: tuple[str, ...] = MEAN_OF) -> float:
        """Mean IoU over those of `classes` that occur in the ground truth."""
        values = [self.iou[name] for name in classes if name in self.iou]
        return sum(values) / len(values) if values else float("nan")

    def table(self) -> str:
        """Table as text: one row per true class, with the percentages of the predicted classes."""
        names = {c.code: c.name for c in CLASSES}
        heads = [names.get(code, str(code))[:9] for code in self.codes]
        lines = [f"{'known as':16s}{'points':>11s}{'IoU':>7s} " + "".join(f"{head:>10s}" for head in heads)]
        for k, code in enumerate(self.codes):
            total = self.count[k].sum()
            if total:
                name = names.get(code, str(code))
                shares = "".join(f"{100 * n / total:10.1f}" for n in self.count[k])
                lines.append(f"{name:16s}{total:11,d}{self.iou[name]:7.3f} {shares}")
        return "\n".join(lines)


def confusion(known: U8, predicted: U8) -> Confusion:
    """Confusion matrix of LAS codes (N,); unknown classes and noise are left out, mid vegetation counts as low."""
    known, predicted = _merged(known), _merged(predicted)
    some = ~np.isin(known, (*UNKNOWN, 7, 18))
    known, predicted = known[some], predicted[some]
    codes = np.union1d(known, predicted)
    at = np.zeros(256, np.int64)
    at[codes] = np.arange(len(codes))
    count = np.bincount(at[known] * len(codes) + at[predicted], minlength=len(codes) ** 2).reshape(len(codes), -1)
    return Confusion(tuple(int(c) for c in codes), count)


def _merged(classification: U8) -> U8:
    return np.where(classification == CODE["mid_vegetation"], CODE["low_vegetation"], classification).astype(np.uint8)
