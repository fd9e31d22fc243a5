"""Checks of the cameras: their height over the ground, and their distance from the points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scan2sim.pipeline.core.types import F64, PointCloud, View
from scan2sim.pipeline.plausibility.finding import Finding

MIN_CAMERAS = 3
AROUND_M = 5.0
"""Horizontal distance up to which points are below a camera."""
GROUND_PERCENT = 10.0
"""Percentile of the heights below a camera that is the ground."""
LEVEL_MAX_Z = 0.5
"""Largest absolute z of the viewing direction of a camera on a vehicle: 30 degrees from the horizontal."""
LOW_M, HIGH_M = -1.0, 12.0
"""Heights over the ground of cameras on vehicles and on people."""
USUAL_M = 2.0
"""Height over the ground of a camera on a car or a person, roughly."""
MAX_SPREAD_M = 8.0
"""Spread of the heights (10 % to 90 %) up to which the cameras move over ground; drones vary more."""
MAX_AWAY_M = 50.0


def heights(views: Sequence[View], cloud: PointCloud) -> Finding | None:
    """Cameras that look level, yet all are far above or below the ground under them."""
    level = [view for view in views if abs(view.T_world_cam[2, 2]) < LEVEL_MAX_Z]
    if len(level) < MIN_CAMERAS:
        return None
    position = np.array([view.T_world_cam[:3, 3] for view in level])
    above = position[:, 2] - _ground_below(position, cloud)
    above = above[np.isfinite(above)]
    if len(above) < MIN_CAMERAS:
        return None
    middle, (low, high) = float(np.median(above)), np.percentile(above, (10, 90))
    if LOW_M <= middle <= HIGH_M or high - low > MAX_SPREAD_M:
        return None
    where = f"{middle:.1f} m above" if middle > 0 else f"{-middle:.1f} m below"
    shift = middle - USUAL_M
    change = f"subtract {shift:.1f} m from" if shift > 0 else f"add {-shift:.1f} m to"
    return Finding(
        3,
        f"the cameras are {where} the ground under them, though they look level. Heights of photos and cloud are "
        "probably of different kinds: above the ellipsoid (GNSS) and above the sea (the geoid, which is up to 85 m "
        f"above and 107 m below it). For cameras {USUAL_M:g} m above the ground, {change} the photos' heights",
    )


def distance(views: Sequence[View], cloud: PointCloud) -> Finding | None:
    """Cameras that are far from all points."""
    from scipy.spatial import cKDTree

    if len(views) < MIN_CAMERAS:
        return None
    position = np.array([view.T_world_cam[:3, 3] for view in views])
    away = cKDTree(cloud.xyz[:, :2]).query(position[:, :2])[0]
    middle = float(np.median(away))
    if middle <= MAX_AWAY_M:
        return None
    return Finding(
        3,
        f"half of the cameras are more than {middle:,.0f} m from any point: the photos are of another place, or their "
        "coordinates are of another CRS, unit or order of the axes than the cloud's. Give the photos of this place, or "
        "name theirs (`import clouds` has --photos-crs, --photos-units, --position-axes)",
    )


def _ground_below(position: F64, cloud: PointCloud) -> F64:
    """Height of the ground (N,) below positions (N, 3); NaN where there are no points."""
    from scipy.spatial import cKDTree

    near = cKDTree(cloud.xyz[:, :2]).query_ball_point(position[:, :2], AROUND_M)
    z = cloud.xyz[:, 2]
    return np.array([np.percentile(z[index], GROUND_PERCENT) if index else np.nan for index in near])
