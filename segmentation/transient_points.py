"""What moved while it was scanned: the scanner passes what stands for seconds, what drives past only for a moment.

Such points are a trail in the air; photos of any other time see through it, and their votes say what is behind.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from scan2sim.pipeline.camera.depth_map import times_of_moving
from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.types import F32, Bools, PointCloud

HEIGHTS = (0.15, 2.6)
"""Metres above ground between which things that move are looked for."""
LASTING = 10.0
"""Seconds that a survey must last: in a shorter one what stands is passed in a moment, too."""
AROUND, SHARE, NEIGHBOURS = 0.6, 0.7, 24
"""Of a point's neighbours within so many metres, this share must have moved, too."""


def moving(cloud: PointCloud, height: F32, ground: Bools) -> Bools:
    """(N,) which points are of moving things; none where points have no time, or the survey is short.

    Args:
        cloud: thinned, with time.
        height: (N,) metres above ground.
        ground: (N,) which points are of it.
    """
    from scipy.spatial import cKDTree

    out = np.zeros(len(cloud), bool)
    some = np.flatnonzero(~ground & (height > HEIGHTS[0]) & (height < HEIGHTS[1]))
    if cloud.time is None or len(some) < NEIGHBOURS or np.ptp(cloud.time) < LASTING:
        return out
    part = replace(cloud.take(some), classification=np.full(len(some), CODE["vehicle"], np.uint8))
    moved = ~np.isnan(times_of_moving(part))
    k = min(NEIGHBOURS, len(some))
    distance, near = cKDTree(part.xyz).query(part.xyz, k=k, distance_upper_bound=AROUND, workers=-1)
    there = np.isfinite(distance)
    share = (np.append(moved, False)[near] & there).sum(axis=1) / np.maximum(there.sum(axis=1), 1)
    out[some] = share > SHARE
    return out
