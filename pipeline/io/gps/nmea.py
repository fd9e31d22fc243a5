"""GPS tracks as NMEA 0183 logs: GGA and RMC sentences."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import GpsTrack
from scan2sim.pipeline.io.gps_fixes import RANGE_ERROR_M, sigma_from_dop, to_float, track_from_wgs84

SUFFIXES = (".nmea", ".txt", ".log")
RANGE_ERROR_BY_QUALITY_M = {2: 0.8, 4: 0.02, 5: 0.3}
"""User equivalent range error by GGA's fix quality: differential, RTK fixed, RTK float."""


def read(path: Path) -> GpsTrack:
    """GGA sentences (position, quality, HDOP), dated by the nearest RMC; sentences with wrong checksums are skipped."""
    fixes: list[list[float]] = []  # their time is the time of day, seconds
    clocks: list[float] = []  # UNIX time of the last RMC before each fix, NaN before the first
    clock, sentences = math.nan, 0
    for line in path.read_text(encoding="ascii", errors="replace").splitlines():
        fields = _sentence(line)
        sentences += bool(fields)
        kind = fields[0][-3:] if fields else ""
        if kind == "RMC" and len(fields) > 9 and fields[2] == "A":
            clock = _nmea_date(fields[9]) + _nmea_clock(fields[1])
        elif kind == "GGA" and len(fields) > 9 and fields[6].isdigit() and int(fields[6]) in (1, 2, 3, 4, 5):
            sigma = sigma_from_dop(to_float(fields[8]), RANGE_ERROR_BY_QUALITY_M.get(int(fields[6]), RANGE_ERROR_M))
            position = _nmea_angle(fields[2], fields[3]), _nmea_angle(fields[4], fields[5])
            fixes.append([_nmea_clock(fields[1]), *position, to_float(fields[9]), sigma])
            clocks.append(clock)
    if not sentences:
        raise InputError(path, "contains no NMEA sentence with a valid checksum", "Give the receiver's original log")
    if fixes and np.isnan(clocks).all():
        if math.isnan(clock):
            raise InputError(path, "has fixes, but no date (no valid RMC sentence)", "Log RMC sentences besides GGA")
        clocks[-1] = clock  # a single RMC, after all fixes
    rows, rmc_clock = np.array(fixes).reshape(-1, 5), np.array(clocks)
    if len(rows):
        known = np.flatnonzero(~np.isnan(rmc_clock))
        rmc_clock = rmc_clock[known[np.maximum(np.searchsorted(known, np.arange(len(rmc_clock)), side="right") - 1, 0)]]
        rows[:, 0] += np.round((rmc_clock - rows[:, 0]) / 86400) * 86400  # the day that is nearest to that RMC
    return track_from_wgs84(path, rows.tolist())


def _sentence(line: str) -> list[str]:
    """The fields of an NMEA sentence; empty if its checksum is missing or wrong."""
    body, star, given = line.strip().partition("$")[2].partition("*")
    total = 0
    for character in body:
        total ^= ord(character)
    return body.split(",") if star and given[:2].upper() == f"{total:02X}" else []


def _nmea_angle(text: str, side: str) -> float:
    """Degrees of (d)ddmm.mmmm."""
    value = to_float(text)
    degrees = value // 100
    return (degrees + (value - 100 * degrees) / 60) * (-1 if side in ("S", "W") else 1)


def _nmea_clock(text: str) -> float:
    """Seconds of the day of hhmmss.ss."""
    return 3600 * to_float(text[:2]) + 60 * to_float(text[2:4]) + to_float(text[4:])


def _nmea_date(text: str) -> float:
    """UNIX time of the beginning of ddmmyy."""
    try:
        return datetime.strptime(text, "%d%m%y").replace(tzinfo=UTC).timestamp()
    except ValueError:
        return math.nan
