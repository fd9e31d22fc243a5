"""GPS tracks as CSV, columns by name."""

from __future__ import annotations

import csv
import math
import re
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import Frame, GpsTrack
from scan2sim.pipeline.io.gps_fixes import located, number, seconds, sigma_of, tidy

SUFFIXES = (".csv",)


def read(path: Path) -> GpsTrack:
    """The track of a table with a heading: see `_table`."""
    try:
        return _table(path)
    except csv.Error as error:
        raise InputError(path, f"is no readable CSV ({error})", "Export it again") from None


def _table(path: Path) -> GpsTrack:
    """Columns by name: time, latitude, longitude[, altitude][, hdop or accuracy]; or time, x, y, z in local metres."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(path, "is no text", "Write a CSV with a heading") from None
    first = text.lstrip("\n").partition("\n")[0]
    delimiter = max(",;\t", key=first.count)
    table = csv.DictReader((line for line in text.splitlines() if line.strip()), delimiter=delimiter)
    names = {re.sub(r"\W.*", "", name.strip(" #").lower()): name for name in table.fieldnames or ()}  # "lat (deg)"

    def column(*wanted: str) -> str | None:
        return next((names[name] for name in wanted if name in names), None)

    time, lat, lon = column("time", "timestamp"), column("latitude", "lat"), column("longitude", "lon", "lng")
    height, dop, accuracy = column("altitude", "alt", "ele"), column("hdop"), column("accuracy", "sigma")
    x, y, z = (column(name) for name in "xyz")
    local = lat is None or lon is None
    if time is None or (local and (x is None or y is None)):
        raise InputError(
            path, f"lacks columns (it has {first[:80]})", "Name them time,latitude,longitude,altitude or time,x,y,z"
        )
    places = (x, y, z) if local else (lat, lon, height)
    rows = []
    for row in table:
        place = [number(row.get(name)) if name else math.nan for name in places]
        sigma = number(row.get(accuracy)) if accuracy else sigma_of(number(row.get(dop)) if dop else math.nan)
        rows.append([seconds(row[time] or ""), *place, sigma])
    if not local:
        return located(path, rows)
    data = np.array(rows, np.float64).reshape(-1, 5)
    data = data[np.isfinite(data[:, :3]).all(axis=1) & ~np.isinf(data[:, 4])]
    return tidy(path, data[:, 0], data[:, 1:4], data[:, 4], Frame())
