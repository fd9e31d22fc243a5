"""GPS tracks as CSV with named columns."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import Frame, GpsTrack
from scan2sim.pipeline.io import tables
from scan2sim.pipeline.io.gps_fixes import clean_track, sigma_from_dop, to_float, to_seconds, track_from_wgs84
from scan2sim.pipeline.io.trajectory_columns import seconds

SUFFIXES = (".csv",)
TIMES, LATITUDES = ("time", "timestamp"), ("latitude", "lat", "latitude_deg", "lat_deg")
LONGITUDES = ("longitude", "lon", "lng", "long", "longitude_deg", "lon_deg")
HEIGHTS = ("altitude", "alt", "ele", "elevation", "elev", "height", "altitude_m", "alt_m", "height_m", "elevation_m")
SECONDS = {"ms": 1e-3, "millisecond": 1e-3, "milliseconds": 1e-3, "us": 1e-6, "ns": 1e-9}
METRES = {"ft": 0.3048, "feet": 0.3048, "foot": 0.3048, "km": 1000.0}
DEGREES = dict.fromkeys(("rad", "radian", "radians"), 180 / math.pi)
"""Units in brackets after the name of a column; others are seconds, metres and degrees."""


def read(path: Path) -> GpsTrack:
    """The track of a table with a header line: see `_read_table`."""
    try:
        return _read_table(path)
    except csv.Error as error:
        raise InputError(path, f"is not a readable CSV ({error})", "Export it again") from None


def _read_table(path: Path) -> GpsTrack:
    """Columns by name: time, latitude, longitude[, altitude][, hdop or accuracy]; or time, x, y, z in local metres.

    Times are ISO 8601, seconds, units of the epoch that are recognized by their size, or in the unit that the column's
    name has in brackets; so are heights.
    """
    text = tables.read_text(path)
    first = text.lstrip("\n").partition("\n")[0]
    delimiter = max(",;\t", key=first.count)
    table = csv.DictReader((line for line in text.splitlines() if line.strip()), delimiter=delimiter)
    names = {re.sub(r"\W.*", "", name.strip(" #").lower()): name for name in table.fieldnames or ()}  # "lat (deg)"

    def column(*candidates: str) -> str | None:
        return next((names[name] for name in candidates if name in names), None)

    time, lat, lon, height = (column(*known) for known in (TIMES, LATITUDES, LONGITUDES, HEIGHTS))
    dop, accuracy = column("hdop"), column("accuracy", "sigma")
    x, y, z = (column(name) for name in "xyz")
    local = lat is None or lon is None
    if time is None or (local and (x is None or y is None)):
        raise InputError(
            path,
            f"has missing columns (its header line: {first[:80]})",
            "Use time,latitude,longitude,altitude or time,x,y,z",
        )
    position_columns = (x, y, z) if local else (lat, lon, height)
    rows = []
    for row in table:
        position = [to_float(row.get(name)) if name else math.nan for name in position_columns]
        sigma = to_float(row.get(accuracy)) if accuracy else sigma_from_dop(to_float(row.get(dop)) if dop else math.nan)
        rows.append([to_seconds(row[time] or ""), *position, sigma])
    data = np.array(rows, np.float64).reshape(-1, 5)
    unit = _unit(time, SECONDS)
    finite = np.isfinite(data[:, 0])  # one time without a value must not hide the unit of the others
    data[finite, 0] = data[finite, 0] * unit if unit != 1 else seconds(data[finite, 0])
    if not local:
        data[:, 1:4] *= [_unit(lat, DEGREES), _unit(lon, DEGREES), _unit(height, METRES)]
        return track_from_wgs84(path, data.tolist())
    data[:, 1:4] *= [_unit(name, METRES) for name in (x, y, z)]
    data = data[np.isfinite(data[:, :3]).all(axis=1) & ~np.isinf(data[:, 4])]
    return clean_track(path, data[:, 0], data[:, 1:4], data[:, 4], Frame())


def _unit(name: str | None, units: Mapping[str, float]) -> float:
    """Factor of the unit in brackets in a column's name, such as "altitude (feet)"; 1 if there is none."""
    found = re.search(r"[(\[]\s*(\w+)", name or "")
    return units.get(found[1].lower(), 1.0) if found else 1.0
