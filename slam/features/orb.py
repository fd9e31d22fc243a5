"""ORB (Rublee et al. 2011) by OpenCV: corners with descriptors of 256 bits. Needs no weights."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.types import F64, I64, U8
from scan2sim.slam.features import Found, enlarged, no_weights, reduced, unmasked

THRESHOLD = 7
"""Of FAST, grey values: low, as walls and roads have little contrast."""
SPREAD, CELL = 4, 40
"""So many times the features are found, and shared out between cells of so many pixels: else most are in few places."""


def load(weights: Path | None, count: int, upsample: int, device: str) -> Orb:
    """See `slam.features.named`."""
    no_weights("orb", weights)
    return Orb(count, upsample)


class Orb:
    """See `slam.features.Features`."""

    name, binary, dimension = "orb", True, 32

    def __init__(self, count: int, upsample: int) -> None:
        self.count, self.upsample = count, upsample

    def detect(self, picture: U8, mask: U8 | None = None) -> Found:
        """See `slam.features.Features`."""
        import cv2

        large, where = enlarged(picture, mask, self.upsample)
        orb = cv2.ORB_create(SPREAD * self.count, fastThreshold=THRESHOLD)
        points = orb.detect(large, where)
        at = np.array([p.pt for p in points], np.float64).reshape(-1, 2)
        chosen = _spread(at, np.array([p.response for p in points]), CELL * self.upsample, self.count)
        points, found = orb.compute(large, [points[i] for i in chosen])
        if found is None:
            return Found(np.zeros((0, 2), np.float32), np.zeros((0, 32), np.uint8), np.zeros(0, np.float32))
        uv = reduced([p.pt for p in points], self.upsample)
        scores = np.array([p.response for p in points], np.float32)
        return unmasked(Found(uv, np.asarray(found, np.uint8), scores), mask)

    def describe(self) -> str:
        """See `slam.features.Features`."""
        return f"ORB on pictures enlarged {self.upsample} times, by OpenCV"


def _spread(uv: F64, scores: F64, cell: float, count: int) -> I64:
    """(M,) rows of places (N, 2), `count` at most: the best of every cell, then the second best of every cell ..."""
    column, line = (uv // cell).astype(np.int64).T
    number = line * (column.max(initial=0) + 1) + column
    order = np.lexsort((-scores, number))
    rank = np.arange(len(order)) - np.searchsorted(number[order], number[order])
    return order[np.argsort(rank, kind="stable")[:count]]
