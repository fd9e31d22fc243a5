"""Intersection over union of boxes."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F64


def iou_matrix(a: npt.ArrayLike, b: npt.ArrayLike) -> F64:
    """(N, M) intersection over union of boxes (N, 4) and (M, 4): left, top, right, bottom."""
    one, other = (np.asarray(boxes, np.float64).reshape(-1, 4) for boxes in (a, b))
    low = np.maximum(one[:, None, :2], other[None, :, :2])
    high = np.minimum(one[:, None, 2:], other[None, :, 2:])
    intersection = np.clip(high - low, 0, None).prod(axis=2)
    areas = [(boxes[:, 2:] - boxes[:, :2]).prod(axis=1) for boxes in (one, other)]
    union = np.maximum(areas[0][:, None] + areas[1][None] - intersection, 1e-9)
    return np.asarray(intersection / union, np.float64)
