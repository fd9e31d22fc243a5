"""SBET files: the path of a GNSS/INS as Applanix POSPac and other programs write it.

Records of 17 little-endian float64: time in seconds of the GPS week; latitude, longitude (radians), height (m);
velocities (m/s); roll, pitch, platform heading, wander angle (radians); accelerations (m/s2) and rates of the body.
The body's axes are x ahead, y right, z down; its heading from north is the platform heading minus the wander angle.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64, Bools, Frame, Trajectory
from scan2sim.pipeline.io.geodata import crs as crs_io

SUFFIXES = (".out", ".sbet")
FIELDS = 17
RECORD_BYTES = 8 * FIELDS
RATE_HZ = 50.0
"""Rate to which records are thinned: between them, a vehicle's path differs from a straight line by less than 1 mm."""
MAX_HEIGHT_M = 12_000.0
REMEDY = "Export it again as SBET, or as text: time,x,y,z,qx,qy,qz,qw in the clouds' CRS"
NED_TO_ENU = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
DOWN_TO_UP = np.diag([1.0, -1, -1])
"""(3, 3) axes of the body: x ahead, y left, z up to x ahead, y right, z down."""


def is_sbet(path: Path) -> bool:
    """Whether a file is an SBET file: by its suffix, its size and its first record."""
    if path.suffix.lower() not in SUFFIXES or not path.is_file():
        return False
    size = path.stat().st_size
    if not size or size % RECORD_BYTES:
        return False
    return bool(_plausible(np.fromfile(path, "<f8", FIELDS)[None]).all())


class Description(NamedTuple):
    """What an SBET file contains: number and rate of its records; ranges of seconds, degrees and metres."""

    records: int
    rate_hz: float
    times: tuple[float, float]
    latitude: tuple[float, float]
    longitude: tuple[float, float]
    height: tuple[float, float]


def describe(path: Path) -> Description:
    """What a file contains for which `is_sbet` is true.

    Raises:
        InputError: records are damaged.
    """
    rows = _records(path)
    shown = rows[:, :4] * [1, math.degrees(1), math.degrees(1), 1]
    ranges = zip(shown.min(axis=0).tolist(), shown.max(axis=0).tolist(), strict=True)
    times, latitude, longitude, height = ranges
    return Description(len(rows), 1 / _interval(rows), times, latitude, longitude, height)


def read(path: Path, frame: Frame) -> Trajectory:
    """Read an SBET file: positions local to `frame`, rotations from a body's axes (x ahead, y left, z up) to grid axes.

    Heights are those of the file, which are usually above the ellipsoid. Times are in the file's clock.

    Args:
        path: the file; `is_sbet` is true.
        frame: projected CRS, its unit, and the local origin.

    Raises:
        InputError: `frame` has no CRS, or records are damaged.
    """
    if frame.crs == crs_io.LOCAL:
        raise InputError(path, "has positions in degrees, which need a CRS", "Give that of the clouds: --crs EPSG:...")
    rows = _records(path)
    rows = rows[:: max(1, round(1 / (RATE_HZ * _interval(rows))))]
    rows = rows[np.unique(rows[:, 0], return_index=True)[1]]
    latitude, longitude = np.degrees(rows[:, 1]), np.degrees(rows[:, 2])
    xy, convergence = _projected(latitude, longitude, frame.crs)
    positions = frame.to_local(np.column_stack([xy, rows[:, 3]]) / frame.unit)
    return Trajectory(rows[:, 0], positions, _rotations(rows, convergence))


def _records(path: Path) -> F64:
    """All records (T, 17)."""
    rows = np.fromfile(path, "<f8").reshape(-1, FIELDS)
    odd = np.flatnonzero(~_plausible(rows))
    if len(odd):
        raise InputError(path, f"is damaged at record {odd[0] + 1} of {len(rows)}", REMEDY)
    return rows


def _interval(rows: F64) -> float:
    """Seconds between records, 1 of a single one."""
    return max(float(np.median(np.diff(rows[:, 0]))), 1e-6) if len(rows) > 1 else 1.0


def _plausible(rows: F64) -> Bools:
    with np.errstate(invalid="ignore"):
        return np.asarray(
            np.isfinite(rows).all(axis=1)
            & (np.abs(rows[:, 1]) <= math.pi / 2) & (np.abs(rows[:, 2]) <= 2 * math.pi)
            & (np.abs(rows[:, 3]) < MAX_HEIGHT_M) & (rows[:, 0] >= 0)
            & (np.abs(rows[:, 7:9]) <= math.pi).all(axis=1) & (np.abs(rows[:, 9:11]) <= 3 * math.pi).all(axis=1)
        )  # fmt: skip


def _projected(latitude: F64, longitude: F64, crs: str) -> tuple[F64, F64]:
    """Positions (T, 2) in a CRS, metres, and (T,) angle from true to grid north, clockwise, radians."""
    from pyproj import CRS, Proj, Transformer

    plane = CRS.from_user_input(crs).to_2d()
    xy = np.column_stack(Transformer.from_crs("EPSG:4326", plane, always_xy=True).transform(longitude, latitude))
    factors = Proj(plane).get_factors(longitude, latitude)
    metres = plane.axis_info[0].unit_conversion_factor
    return xy * metres, np.radians(np.asarray(factors.meridian_convergence))


def _rotations(rows: F64, convergence: F64) -> F64:
    """(T, 3, 3) from the body's axes (x ahead, y left, z up) to grid axes."""
    from scipy.spatial.transform import Rotation

    heading = rows[:, 9] - rows[:, 10]
    to_ned = Rotation.from_euler("ZYX", np.column_stack([heading, rows[:, 8], rows[:, 7]])).as_matrix()
    to_grid = Rotation.from_euler("z", convergence[:, None]).as_matrix()
    return np.asarray(to_grid @ NED_TO_ENU @ to_ned @ DOWN_TO_UP)
