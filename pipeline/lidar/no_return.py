"""Surface that gave no return: the scanner's rays reached it, and none came back (glass, a wet road, black paint)."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.types import F32, Bools
from scan2sim.pipeline.lidar.casting import Scanner
from scan2sim.pipeline.lidar.unreturned import UnreturnedRays

SUPPORT_M = 0.25
"""Distance up to which a return supports surface, and a ray without a return counts against it."""
MAX_RANGE_M = 40.0
"""Range up to which a ray is expected to come back: beyond it, dark road is too weak for a return, too."""
VEHICLE_RADIUS_M = 4.0
"""Horizontal distance from the scanner up to which its own vehicle swallows rays."""


def unreturned_hits(rays: UnreturnedRays, scanner: Scanner) -> F32:
    """Points (M, 3), local metres, at which rays without a return meet the world's surface."""
    distance, surface = scanner.cast(rays.origins, rays.directions)
    hit = (surface >= 0) & (distance < MAX_RANGE_M)
    hit &= distance * np.hypot(rays.directions[:, 0], rays.directions[:, 1]) > VEHICLE_RADIUS_M
    return (rays.origins[hit] + distance[hit, None] * rays.directions[hit]).astype(np.float32)


def gave_no_return(vertices: F32, returns: F32, hits: F32) -> Bools:
    """(V,) whether vertices (V, 3) are within `SUPPORT_M` of a ray without a return, but of no return.

    Args:
        vertices: of the world's surface, local metres.
        returns: (N, 3) the returns of all sweeps.
        hits: (M, 3) of `unreturned_hits`.
    """
    from scipy.spatial import cKDTree

    found = np.zeros(len(vertices), bool)
    if not len(hits) or not len(returns):
        return found
    near, _ = cKDTree(hits).query(vertices, distance_upper_bound=SUPPORT_M, workers=-1)
    reached = np.flatnonzero(np.isfinite(near))
    apart, _ = cKDTree(returns).query(vertices[reached], distance_upper_bound=SUPPORT_M, workers=-1)
    found[reached] = ~np.isfinite(apart)
    return found
