"""GPS fixes as the formats of `pipeline.io.gps` read them: projected to their UTM zone, sorted, outliers rejected."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64, I64, Frame, GpsTrack
from scan2sim.pipeline.io.geodata.crs import utm

MAX_SPEED_M_S = 70.0
"""Maximum speed of a vehicle (252 km/h): a fix that would need more is an outlier."""
MAX_DOP = 5.0
"""Dilution of precision above which a fix is rejected (recommended by GoPro)."""
RANGE_ERROR_M = 1.5
"""User equivalent range error: metres of error per unit of dilution of precision, consumer receiver, open sky."""


def track_from_wgs84(path: Path, rows: Sequence[Sequence[float]]) -> GpsTrack:
    """Track in the UTM zone of its fixes, from rows of time, latitude, longitude, height, sigma."""
    from pyproj import Transformer

    data = np.array(rows, np.float64).reshape(-1, 5)
    time, lat, lon, height, sigma = data.T
    null = (lat == 0) & (lon == 0)  # receivers write zeros before their first fix
    data = data[np.isfinite(time) & (np.abs(lat) <= 84) & (np.abs(lon) <= 180) & ~null & ~np.isinf(sigma)]
    if not len(data):
        raise InputError(path, f"has no usable GPS fix ({len(rows)} points)", "Give a track with times and positions")
    time, lat, lon, height, sigma = data.T
    middle = data[np.argsort(lon)[len(data) // 2]]  # median longitude: an outlier must not choose the zone
    crs = utm(middle[1], middle[2])
    east, north = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(lon, lat)
    known = np.isfinite(height)
    order = np.argsort(time[known], kind="stable")
    height = np.interp(time, time[known][order], height[known][order]) if known.any() else np.zeros(len(time))
    return clean_track(path, time, np.column_stack([east, north, height]), sigma, Frame(crs))


def clean_track(path: Path, times: F64, positions: F64, sigma: F64, frame: Frame) -> GpsTrack:
    """Track of fixes in CRS metres: sorted, each time once, outliers rejected, local to its first fix."""
    if not len(times):
        raise InputError(path, "has no usable GPS fix", "Give a track with times and positions")
    _, order = np.unique(times, return_index=True)
    keep = order[reject_jumps(times[order], positions[order, :2])]
    times, positions, sigma = times[keep], np.where(np.isfinite(positions[keep]), positions[keep], 0.0), sigma[keep]
    if frame.crs != "local":
        x, y, z = np.floor(positions[0]).tolist()
        frame = Frame(frame.crs, (x, y, z))
        positions = frame.to_local(positions)
    known = sigma > 0
    return GpsTrack(times, positions, np.where(known, sigma, RANGE_ERROR_M) if known.any() else None, frame)


def reject_jumps(times: F64, xy: F64, max_speed: float = MAX_SPEED_M_S, lookback: int = 1000) -> I64:
    """Indices of the longest chain of fixes, (N,) `times` and (N, 2) `xy`, that `max_speed` (m/s) can connect.

    The longest chain rather than the first one, so that a wrong first fix doesn't reject all others. The predecessor
    of a fix is searched among the last `lookback` fixes, and among all earlier ones if none of those is reachable.
    """
    if (np.hypot(*np.diff(xy, axis=0).T) <= max_speed * np.diff(times)).all():
        return np.arange(len(times))
    length, before = np.ones(len(times), int), np.full(len(times), -1)
    for i in range(1, len(times)):
        for low, high in ((max(0, i - lookback), i), (0, max(0, i - lookback))):
            distance = np.hypot(xy[low:high, 0] - xy[i, 0], xy[low:high, 1] - xy[i, 1])
            possible = np.flatnonzero(distance <= max_speed * (times[i] - times[low:high]))
            if len(possible):
                best = low + possible[len(possible) - 1 - np.argmax(length[low + possible][::-1])]
                length[i], before[i] = length[best] + 1, best
                break
    chain = [int(np.argmax(length))]
    while before[chain[-1]] >= 0:
        chain.append(int(before[chain[-1]]))
    return np.array(chain[::-1])


def to_float(text: str | None) -> float:
    """Parse a number; NaN if the text is none."""
    try:
        return float(text) if text else math.nan
    except ValueError:
        return math.nan


def to_seconds(text: str) -> float:
    """Parse seconds, or an ISO 8601 time to UNIX seconds (UTC if it names no zone); NaN for anything else."""
    value = to_float(text)
    if math.isnan(value):
        try:
            moment = datetime.fromisoformat(text.strip())
        except ValueError:
            return math.nan
        value = moment.replace(tzinfo=moment.tzinfo or UTC).timestamp()
    return value


def sigma_from_dop(dop: float, range_error: float = RANGE_ERROR_M) -> float:
    """Standard deviation (m) for a dilution of precision; infinite if too high to use, NaN if unknown (0 or NaN)."""
    return math.inf if dop > MAX_DOP else range_error * dop if dop > 0 else math.nan
