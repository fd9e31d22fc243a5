"""Mutual nearest neighbours of descriptors with Lowe's ratio test. Needs no weights; takes any features."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import I64, Bools
from scan2sim.slam.features import FeatureSet, no_weights
from scan2sim.slam.matchers import Sizes

RATIO_MAX = 0.9
"""Ratio test: distance to the nearest descriptor by that to the second nearest. Looser than Lowe's 0.8: consecutive
frames differ little, and Lucas-Kanade verifies every match."""
BLOCK_ROWS = 2048
"""Number of descriptors compared at a time, to bound memory."""


def load(weights: Path | None, device: str) -> Nearest:
    """See `slam.matchers.named`."""
    no_weights("nearest", weights)
    return Nearest()


class Nearest:
    """See `slam.matchers.Matcher`."""

    name, takes, dimension = "nearest", None, None

    def __init__(self, ratio: float = RATIO_MAX) -> None:
        self.ratio = ratio

    def match(self, a: FeatureSet, b: FeatureSet, sizes: Sizes) -> I64:
        """See `slam.matchers.Matcher`."""
        if len(a.uv) < 2 or len(b.uv) < 2:
            return np.zeros((0, 2), np.int64)
        forward, distinct = _nearest(a.descriptors, b.descriptors, self.ratio)
        backward, distinct_backward = _nearest(b.descriptors, a.descriptors, self.ratio)
        rows = np.arange(len(forward))
        good = (backward[forward] == rows) & distinct & distinct_backward[forward]
        return np.stack([rows[good], forward[good]], axis=1).astype(np.int64)

    def describe(self) -> str:
        """See `slam.matchers.Matcher`."""
        return f"mutual nearest neighbours, ratio test {self.ratio}"


def _nearest(a: npt.NDArray[Any], b: npt.NDArray[Any], ratio: float) -> tuple[I64, Bools]:
    """(N,) row in b of the nearest neighbour of each descriptor in a, and (N,) whether it passes the ratio test."""
    if a.dtype == np.uint8:
        import cv2

        pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(a, b, k=2)
        index = np.array([p[0].trainIdx for p in pairs], np.int64)
        distance = np.array([(p[0].distance, p[1].distance) for p in pairs])
        return index, distance[:, 0] < ratio * distance[:, 1]
    index, distinct = np.empty(len(a), np.int64), np.empty(len(a), bool)
    norms = np.einsum("nd,nd->n", b, b)
    for first in range(0, len(a), BLOCK_ROWS):
        part = a[first : first + BLOCK_ROWS]
        squares = np.einsum("nd,nd->n", part, part)[:, None] + norms - 2 * part @ b.T
        two = np.argpartition(squares, 1, axis=1)[:, :2]
        near = np.take_along_axis(squares, two, axis=1)
        rows, swap = slice(first, first + len(part)), near[:, 1] < near[:, 0]
        index[rows] = np.where(swap, two[:, 1], two[:, 0])
        distinct[rows] = near.min(axis=1) < ratio**2 * near.max(axis=1)
    return index, distinct
