"""ORB features (Rublee et al. 2011) by OpenCV: corners with descriptors of 256 bits. Needs no weights."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.types import F64, I64, U8
from scan2sim.slam.features import FeatureSet, enlarged, no_weights, reduced, unmasked

FAST_THRESHOLD = 7
"""Grey values; low, as walls and roads have little contrast."""
CANDIDATE_FACTOR, CELL_PX = 4, 40
"""This multiple of `count` is detected, then distributed over grid cells of this size; otherwise features cluster."""


def load(weights: Path | None, count: int, upsample: int, device: str) -> Orb:
    """See `slam.features.named`."""
    no_weights("orb", weights)
    return Orb(count, upsample)


class Orb:
    """See `slam.features.Features`."""

    name, binary, dimension = "orb", True, 32

    def __init__(self, count: int, upsample: int) -> None:
        self.count, self.upsample = count, upsample

    def detect(self, image: U8, mask: U8 | None = None) -> FeatureSet:
        """See `slam.features.Features`."""
        import cv2

        large, where = enlarged(image, mask, self.upsample)
        orb = cv2.ORB_create(CANDIDATE_FACTOR * self.count, fastThreshold=FAST_THRESHOLD)
        points = orb.detect(large, where)
        at = np.array([p.pt for p in points], np.float64).reshape(-1, 2)
        chosen = _distributed(at, np.array([p.response for p in points]), CELL_PX * self.upsample, self.count)
        points, descriptors = orb.compute(large, [points[i] for i in chosen])
        if descriptors is None:
            return FeatureSet(np.zeros((0, 2), np.float32), np.zeros((0, 32), np.uint8), np.zeros(0, np.float32))
        uv = reduced([p.pt for p in points], self.upsample)
        scores = np.array([p.response for p in points], np.float32)
        return unmasked(FeatureSet(uv, np.asarray(descriptors, np.uint8), scores), mask)

    def describe(self) -> str:
        """See `slam.features.Features`."""
        return f"ORB by OpenCV, images enlarged {self.upsample} times"


def _distributed(uv: F64, scores: F64, cell: float, count: int) -> I64:
    """(M,) rows of at most `count` pixels (N, 2): first the best of every cell, then the second best, and so on."""
    column, line = (uv // cell).astype(np.int64).T
    number = line * (column.max(initial=0) + 1) + column
    order = np.lexsort((-scores, number))
    rank = np.arange(len(order)) - np.searchsorted(number[order], number[order])
    return order[np.argsort(rank, kind="stable")[:count]]
