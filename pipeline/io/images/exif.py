"""Where a photo's EXIF says that it was taken, and with what lens."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

GPS, EXIF = 0x8825, 0x8769
LATITUDE_REF, LATITUDE, LONGITUDE_REF, LONGITUDE, ALTITUDE_REF, ALTITUDE = 1, 2, 3, 4, 5, 6
FOCAL, FOCAL_35MM, WIDE, PLANE_X, PLANE_UNIT = 37386, 41989, 40962, 41486, 41488
MILLIMETRES = {2: 25.4, 3: 10.0, 4: 1.0}
"""Of units in which EXIF gives a sensor's resolution."""


def place(photo: Path) -> tuple[float, float, float | None] | None:
    """Latitude and longitude (degrees), altitude (m, None where it isn't told); None without a usable position."""
    from PIL import Image

    try:
        with Image.open(photo) as image:
            tags = image.getexif().get_ifd(GPS)
        latitude = _degrees(tags[LATITUDE]) * (-1 if str(tags.get(LATITUDE_REF, "N")).upper().startswith("S") else 1)
        longitude = _degrees(tags[LONGITUDE]) * (-1 if str(tags.get(LONGITUDE_REF, "E")).upper().startswith("W") else 1)
    except Exception:  # Pillow's parsers raise whatever damage leads to; a photo without a position is no error
        return None
    null = latitude == 0 and longitude == 0  # what devices write that have no fix
    if null or not (abs(latitude) <= 84 and abs(longitude) <= 180):
        return None
    return latitude, longitude, _altitude(tags)


def focal_35mm(photo: Path) -> float | None:
    """Millimetres that a photo's focal length would be on film of 36 x 24 mm, by its diagonal; None without EXIF."""
    from PIL import Image

    try:
        with Image.open(photo) as image:
            tags, size = image.getexif().get_ifd(EXIF), image.size
        focal = float(tags.get(FOCAL_35MM, 0))
        if not focal:
            dense = float(tags[PLANE_X]) / MILLIMETRES[tags.get(PLANE_UNIT, 2)]  # pixels a millimetre, as it was taken
            smaller = size[0] / float(tags.get(WIDE, size[0]))
            focal = float(tags[FOCAL]) * dense * smaller / math.hypot(*size) * math.hypot(36, 24)
    except Exception:  # as above
        return None
    return focal if 1 < focal < 5000 else None


def _degrees(value: Any) -> float:
    degrees, minutes, seconds = (float(part) for part in value)
    return degrees + minutes / 60 + seconds / 3600


def _altitude(tags: Any) -> float | None:
    try:
        altitude = float(tags[ALTITUDE])
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return None
    below = tags.get(ALTITUDE_REF) in (1, b"\x01")
    return (-altitude if below else altitude) if math.isfinite(altitude) else None
