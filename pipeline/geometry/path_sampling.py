"""Sampling of paths: equidistant positions, and paths without the jitter of a standing vehicle."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from scan2sim.pipeline.core.types import F64

if TYPE_CHECKING:
    pass

PATH_SPACING_M = 5.0
"""Spacing of the samples of a path for distance queries."""


def resample_path(xy: F64) -> F64:
    """Resample a path (N, 2) to positions (M, 2) about `PATH_SPACING_M` apart; gaps are filled by straight lines."""
    xy = thin_path(xy, PATH_SPACING_M)
    out = [xy[:1]]
    for a, b in pairwise(xy):
        steps = max(1, math.ceil(float(np.linalg.norm(b - a)) / PATH_SPACING_M - 0.5))
        out.append(a + (b - a) * (np.arange(1, steps + 1) / steps)[:, None])
    return np.concatenate(out)


def thin_path(xy: F64, step: float) -> F64:
    """The samples of a path (N, 2) that are `step` metres from the previous kept one, and the last.

    Removes the jitter of a standing vehicle, which would add to the arc length.
    """
    kept = [0]
    x, y = xy.T.tolist()
    for i in range(1, len(xy)):
        if math.hypot(x[i] - x[kept[-1]], y[i] - y[kept[-1]]) >= step - 1e-6:
            kept.append(i)
    if kept[-1] != len(xy) - 1:
        kept.append(len(xy) - 1)
    return xy[kept]
