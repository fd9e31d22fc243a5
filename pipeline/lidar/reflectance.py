"""Relative reflectance of points from their intensities, and of the vertices of meshes from the points around.

The effect of range and angle of incidence is measured in the scan itself (`pipeline.lidar.intensity`).
"""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.classes import GROUPS, group_of
from scan2sim.pipeline.core.types import F32, F64, PointCloud, Trajectory
from scan2sim.pipeline.lidar.intensity import range_and_incidence, response

FULL_PERCENTILE = 99.0
"""Percentile of the corrected intensities that is reflectance 1; what reflects more (retroreflectors) is 1, too."""
LEAF_INCIDENCE = 0.5
"""Cosine of the angle of incidence on vegetation: its mean over leaves of all directions; normals are noise there."""
RING_M = 5.0
"""Interval of range in which the share of returns with intensity 0 is measured."""
VERTEX_POINTS = 8
"""Points around a vertex whose median is its reflectance."""


def reflectance(cloud: PointCloud, path: Trajectory | None) -> F32:
    """(N,) reflectance from 0 to 1 of points with intensities, relative to the brightest of the cloud.

    NaN at ranges from which most returns are too weak for an intensity above 0.

    Args:
        cloud: points (N, 3) in metres, classified; `has_intensity` is true.
        path: positions of the sensor in the same frame; None: intensities are only scaled.
    """
    assert cloud.classification is not None and cloud.intensity is not None
    value = cloud.intensity.astype(np.float32)
    if path is not None and len(path):
        distance, incidence = range_and_incidence(cloud, path)
        leaf = group_of()[cloud.classification] == GROUPS.index("vegetation")
        incidence[leaf] = LEAF_INCIDENCE
        value = value / response(value, distance, incidence, cloud.classification)
        ring = (distance / RING_M).astype(np.int64)
        value[np.bincount(ring, value == 0)[ring] > 0.5 * np.bincount(ring)[ring]] = np.nan
    if np.isnan(value).all():
        return value
    full = max(float(np.nanpercentile(value, FULL_PERCENTILE)), 1e-6)
    return np.clip(value / full, 0, 1).astype(np.float32)


def at_vertices(vertices: F32, xyz: F32, values: F32) -> tuple[F32, F64]:
    """Median (V,) of the values (N,) of the points (N, 3) nearest to each vertex (V, 3); (V,) metres to the nearest."""
    from scipy.spatial import cKDTree

    k = min(VERTEX_POINTS, len(xyz))
    distance, nearest = cKDTree(xyz).query(vertices, k=np.arange(1, k + 1), workers=-1)
    return np.median(values[nearest], axis=1).astype(np.float32), distance[:, 0]
