"""Transient points: points of objects that moved while they were scanned.

The scanner sees static objects for seconds, but passing objects only for a moment. Passing objects leave a trail of
points in the air; photos of other times see through it, and their votes are about what is behind it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from scan2sim.pipeline.camera.depth_map import times_of_moving
from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.types import F32, Bools, PointCloud

HEIGHT_RANGE_M = (0.15, 2.6)
"""Heights above ground between which moving objects are searched."""
MIN_SURVEY_S = 10.0
"""Shortest duration of a survey: in shorter ones static objects are passed in a moment, too."""
NEIGHBOURHOOD_M, MOVED_SHARE_MIN, NEIGHBOURS = 0.6, 0.7, 24
"""Share of a point's (up to 24) neighbours within 0.6 m that must have moved, too."""


def transient(cloud: PointCloud, height: F32, ground: Bools) -> Bools:
    """(N,) points of moving objects; none if the points have no time stamps, or the survey is short.

    Args:
        cloud: cloud with one point per voxel, with time.
        height: (N,) metres above ground.
        ground: (N,) which points are ground.
    """
    from scipy.spatial import cKDTree

    out = np.zeros(len(cloud), bool)
    some = np.flatnonzero(~ground & (height > HEIGHT_RANGE_M[0]) & (height < HEIGHT_RANGE_M[1]))
    if cloud.time is None or len(some) < NEIGHBOURS or np.ptp(cloud.time) < MIN_SURVEY_S:
        return out
    part = replace(cloud.take(some), classification=np.full(len(some), CODE["vehicle"], np.uint8))
    moved = ~np.isnan(times_of_moving(part))
    k = min(NEIGHBOURS, len(some))
    distance, near = cKDTree(part.xyz).query(part.xyz, k=k, distance_upper_bound=NEIGHBOURHOOD_M, workers=-1)
    found = np.isfinite(distance)
    share = (np.append(moved, False)[near] & found).sum(axis=1) / np.maximum(found.sum(axis=1), 1)
    out[some] = share > MOVED_SHARE_MIN
    return out
