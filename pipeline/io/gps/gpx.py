"""GPS tracks as GPX 1.0 and 1.1 (topografix.com)."""

from __future__ import annotations

import math
from pathlib import Path
from xml.etree.ElementTree import Element

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import GpsTrack
from scan2sim.pipeline.io import xml
from scan2sim.pipeline.io.gps_fixes import sigma_from_dop, to_float, to_seconds, track_from_wgs84

SUFFIXES = (".gpx",)


def read(path: Path) -> GpsTrack:
    """Track points of all tracks and segments of a GPX 1.0 or 1.1 file."""
    rows, untimed = [], 0
    for point in xml.root(path).iter():
        if _local_name(point) != "trkpt":
            continue
        fields = {_local_name(child): (child.text or "").strip() for child in point}
        time = to_seconds(fields.get("time", ""))
        untimed += math.isnan(time)
        if fields.get("fix") != "none":
            sigma = sigma_from_dop(to_float(fields.get("hdop")))
            latitude_longitude = (to_float(point.get(key)) for key in ("lat", "lon"))
            rows.append([time, *latitude_longitude, to_float(fields.get("ele")), sigma])
    if rows and untimed == len(rows):
        raise InputError(path, "has track points, but no times", "Export the recorded track, not a route or course")
    return track_from_wgs84(path, rows)


def _local_name(element: Element) -> str:
    """An element's tag without its namespace."""
    return str(element.tag).rpartition("}")[2]
