"""GPS tracks as CSV with named columns."""

from __future__ import annotations

import csv
import math
import re
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import Frame, GpsTrack
from scan2sim.pipeline.io import tables
from scan2sim.pipeline.io.gps_fixes import clean_track, sigma_from_dop, to_float, to_seconds, track_from_wgs84

SUFFIXES = (".csv",)


def read(path: Path) -> GpsTrack:
    """The track of a table with a header line: see `_read_table`."""
    try:
        return _read_table(path)
    except csv.Error as error:
        raise InputError(path, f"is not a readable CSV ({error})", "Export it again") from None


def _read_table(path: Path) -> GpsTrack:
    """Columns by name: time, latitude, longitude[, altitude][, hdop or accuracy]; or time, x, y, z in local metres."""
    text = tables.read_text(path)
    first = text.lstrip("\n").partition("\n")[0]
    delimiter = max(",;\t", key=first.count)
    table = csv.DictReader((line for line in text.splitlines() if line.strip()), delimiter=delimiter)
    names = {re.sub(r"\W.*", "", name.strip(" #").lower()): name for name in table.fieldnames or ()}  # "lat (deg)"

    def column(*candidates: str) -> str | None:
        return next((names[name] for name in candidates if name in names), None)

    time, lat, lon = column("time", "timestamp"), column("latitude", "lat"), column("longitude", "lon", "lng")
    height, dop, accuracy = column("altitude", "alt", "ele"), column("hdop"), column("accuracy", "sigma")
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
    if not local:
        return track_from_wgs84(path, rows)
    data = np.array(rows, np.float64).reshape(-1, 5)
    data = data[np.isfinite(data[:, :3]).all(axis=1) & ~np.isinf(data[:, 4])]
    return clean_track(path, data[:, 0], data[:, 1:4], data[:, 4], Frame())
