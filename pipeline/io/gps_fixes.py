"""Fixes of GPS, as the formats of `pipeline.io.gps` have them: tidied, in metres of their UTM zone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64, I64, Frame, GpsTrack
from scan2sim.pipeline.io.geodata.crs import utm

MAX_SPEED = 70.0
"""Metres a second (252 km/h) that no car drives: a fix that would need more is a jump."""
MAX_DOP = 5.0
"""Dilution of precision above which a fix is dropped (GoPro's advice)."""
RANGE_ERROR = 1.5
"""Metres of error for each unit of dilution of precision: a consumer receiver under open sky."""


def located(path: Path, rows: Sequence[Sequence[float]]) -> GpsTrack:
    """The track of rows of time, latitude, longitude, height, sigma, in the UTM zone that it is in."""
    from pyproj import Transformer

    data = np.array(rows, np.float64).reshape(-1, 5)
    time, lat, lon, height, sigma = data.T
    null = (lat == 0) & (lon == 0)  # what receivers write before their first fix
    data = data[np.isfinite(time) & (np.abs(lat) <= 84) & (np.abs(lon) <= 180) & ~null & ~np.isinf(sigma)]
    if not len(data):
        raise InputError(path, f"has no usable GPS fix ({len(rows)} points)", "Give a track with times and positions")
    time, lat, lon, height, sigma = data.T
    middle = data[np.argsort(lon)[len(data) // 2]]  # one wild fix doesn't choose the zone
    crs = utm(middle[1], middle[2])
    east, north = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(lon, lat)
    known = np.isfinite(height)
    order = np.argsort(time[known], kind="stable")
    height = np.interp(time, time[known][order], height[known][order]) if known.any() else np.zeros(len(time))
    return tidy(path, time, np.column_stack([east, north, height]), sigma, Frame(crs))


def tidy(path: Path, times: F64, positions: F64, sigma: F64, frame: Frame) -> GpsTrack:
    """The tidy track of fixes in CRS metres: sorted, each time once, no jumps, local to its first fix."""
    if not len(times):
        raise InputError(path, "has no usable GPS fix", "Give a track with times and positions")
    _, order = np.unique(times, return_index=True)
    keep = order[without_jumps(times[order], positions[order, :2])]
    times, positions, sigma = times[keep], np.where(np.isfinite(positions[keep]), positions[keep], 0.0), sigma[keep]
    if frame.crs != "local":
        x, y, z = np.floor(positions[0]).tolist()
        frame = Frame(frame.crs, (x, y, z))
        positions = frame.to_local(positions)
    known = sigma > 0
    return GpsTrack(times, positions, np.where(known, sigma, RANGE_ERROR) if known.any() else None, frame)


def without_jumps(times: F64, xy: F64, max_speed: float = MAX_SPEED, reach: int = 1000) -> I64:
    """Indices of the most fixes of (N,) `times` and (N, 2) `xy` that one can pass through at `max_speed` (m/s).

    The longest chain rather than the first: a wrong start doesn't take the rest with it. `reach` is the number of
    fixes to look back at for the one before, all of them where none of those will do.
    """
    if (np.hypot(*np.diff(xy, axis=0).T) <= max_speed * np.diff(times)).all():
        return np.arange(len(times))
    length, before = np.ones(len(times), int), np.full(len(times), -1)
    for i in range(1, len(times)):
        for low, high in ((max(0, i - reach), i), (0, max(0, i - reach))):
            away = np.hypot(xy[low:high, 0] - xy[i, 0], xy[low:high, 1] - xy[i, 1])
            possible = np.flatnonzero(away <= max_speed * (times[i] - times[low:high]))
            if len(possible):
                best = low + possible[len(possible) - 1 - np.argmax(length[low + possible][::-1])]
                length[i], before[i] = length[best] + 1, best
                break
    chain = [int(np.argmax(length))]
    while before[chain[-1]] >= 0:
        chain.append(int(before[chain[-1]]))
    return np.array(chain[::-1])


def number(text: str | None) -> float:
    """The number that a text says; NaN where it says none."""
    try:
        return float(text) if text else math.nan
    except ValueError:
        return math.nan


def seconds(text: str) -> float:
    """Seconds of a number, or UNIX seconds of an ISO 8601 time (UTC where it names no zone); NaN for neither."""
    value = number(text)
    if math.isnan(value):
        try:
            moment = datetime.fromisoformat(text.strip())
        except ValueError:
            return math.nan
        value = moment.replace(tzinfo=moment.tzinfo or UTC).timestamp()
    return value


def sigma_of(dop: float, unit: float = RANGE_ERROR) -> float:
    """Metres of a dilution of precision; infinite where it is too high to use, NaN for the 0 of one not known."""
    return math.inf if dop > MAX_DOP else unit * dop if dop > 0 else math.nan
