"""GPX 1.0 and 1.1 (topografix.com)."""

from __future__ import annotations

import math
from pathlib import Path
from xml.etree.ElementTree import Element

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import GpsTrack
from scan2sim.pipeline.io import xml
from scan2sim.pipeline.io.gps_fixes import located, number, seconds, sigma_of

SUFFIXES = (".gpx",)


def read(path: Path) -> GpsTrack:
    """Track points of all tracks and segments of a GPX 1.0 or 1.1 file."""
    rows, untimed = [], 0
    for point in xml.root(path).iter():
        if _bare(point) != "trkpt":
            continue
        about = {_bare(child): (child.text or "").strip() for child in point}
        when = seconds(about.get("time", ""))
        untimed += math.isnan(when)
        if about.get("fix") != "none":
            sigma = sigma_of(number(about.get("hdop")))
            place = (number(point.get(key)) for key in ("lat", "lon"))
            rows.append([when, *place, number(about.get("ele")), sigma])
    if rows and untimed == len(rows):
        raise InputError(path, "has track points, but no times", "Export the recorded track, not a route or course")
    return located(path, rows)


def _bare(element: Element) -> str:
    """An element's tag without its name space."""
    return str(element.tag).rpartition("}")[2]
