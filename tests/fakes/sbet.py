"""Writer of SBET files, from poses in a projected CRS."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pyproj import Geod, Transformer

from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.io.sbet import FIELDS


def write(path: Path, crs: str, times: F64, poses: F64, *, wander: float = 0.3) -> None:
    """Write poses (N, 4, 4), from a body's axes (x ahead, y left, z up) to those of `crs`, in metres.

    True north at each position is the direction, on the ellipsoid, to a point a little farther north in the CRS; so the
    file doesn't depend on a formula for the meridian convergence.
    """
    xyz = poses[:, :3, 3]
    to_degrees = Transformer.from_crs(crs, "EPSG:4326", always_xy=True)
    longitude, latitude = to_degrees.transform(xyz[:, 0], xyz[:, 1])
    up_the_grid = to_degrees.transform(xyz[:, 0], xyz[:, 1] + 100.0)
    grid_north = np.radians(Geod(ellps="WGS84").inv(longitude, latitude, *up_the_grid)[0])
    ahead, left, up = poses[:, :3, 0], poses[:, :3, 1], poses[:, :3, 2]
    heading = np.arctan2(ahead[:, 0], ahead[:, 1]) + grid_north
    pitch, roll = np.arcsin(ahead[:, 2]), np.arctan2(left[:, 2], up[:, 2])
    rows = np.zeros((len(times), FIELDS))
    rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3] = times, np.radians(latitude), np.radians(longitude), xyz[:, 2]
    rows[:, 7], rows[:, 8], rows[:, 9], rows[:, 10] = roll, pitch, heading + wander, wander
    rows.astype("<f8").tofile(path)
