"""EXIF metadata of photos: GPS position, focal length, time and orientation."""

from __future__ import annotations

import math
import re
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from scan2sim.pipeline.io.images.decoders import heif

GPS, EXIF = 0x8825, 0x8769  # tags of the two sub-directories (IFD)
LATITUDE_REF, LATITUDE, LONGITUDE_REF, LONGITUDE, ALTITUDE_REF, ALTITUDE = 1, 2, 3, 4, 5, 6
FOCAL, FOCAL_35MM, ORIGINAL_WIDTH, FOCAL_PLANE_X, FOCAL_PLANE_UNIT = 37386, 41989, 40962, 41486, 41488
ORIENTATION = 274
MAKER, MODEL, LENS_MODEL = 271, 272, 42036
TAKEN, OFFSET, FRACTION = 36867, 36881, 37521  # DateTimeOriginal, OffsetTimeOriginal, SubSecTimeOriginal
XMP_BYTES = 2**18
"""Length of the part of a file that has its XMP: XMP and previews are before the pixels."""
EQUIRECTANGULAR = re.compile(rb"""GPano:ProjectionType\s*[=>]\s*["']?\s*equirectangular""")
UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0}
"""Millimetres of the units in which EXIF gives the resolution of the focal plane."""


def _opened(photo: Path) -> Any:
    from PIL import Image

    if photo.suffix.lower() in heif.SUFFIXES:
        heif.register()
    return Image.open(photo)


def gps_position(photo: Path) -> tuple[float, float, float | None] | None:
    """Latitude and longitude (degrees), altitude (m, None if unknown); None without a usable position."""
    try:
        with _opened(photo) as image:
            tags = image.getexif().get_ifd(GPS)
        latitude = _degrees(tags[LATITUDE]) * (-1 if str(tags.get(LATITUDE_REF, "N")).upper().startswith("S") else 1)
        longitude = _degrees(tags[LONGITUDE]) * (-1 if str(tags.get(LONGITUDE_REF, "E")).upper().startswith("W") else 1)
    except Exception:  # damaged files make Pillow raise any type of exception; a photo may have no position
        return None
    null = latitude == 0 and longitude == 0  # written by devices without a fix
    if null or not (abs(latitude) <= 84 and abs(longitude) <= 180):
        return None
    return latitude, longitude, _altitude(tags)


def focal_35mm(photo: Path) -> float | None:
    """35 mm equivalent focal length (mm), by the diagonal of 36 x 24 mm; None if EXIF doesn't have it."""
    try:
        with _opened(photo) as image:
            tags, size = image.getexif().get_ifd(EXIF), image.size
        focal = float(tags.get(FOCAL_35MM, 0))
        if not focal:
            # resolution of the sensor, and by how much the image was downscaled since
            pixels_per_mm = float(tags[FOCAL_PLANE_X]) / UNIT_MM[tags.get(FOCAL_PLANE_UNIT, 2)]
            scale = size[0] / float(tags.get(ORIGINAL_WIDTH, size[0]))
            focal = float(tags[FOCAL]) * pixels_per_mm * scale / math.hypot(*size) * math.hypot(36, 24)
    except Exception:  # as above
        return None
    return focal if 1 < focal < 5000 else None


def time_taken(photo: Path) -> tuple[float, bool] | None:
    """UNIX time at which a photo was taken, and whether its time zone is known (else UTC is assumed), or None."""
    try:
        with _opened(photo) as image:
            tags = image.getexif().get_ifd(EXIF)
        zone = str(tags.get(OFFSET, "")).strip()
        digits = str(tags.get(FRACTION, "")).strip()
        taken = datetime.strptime(str(tags[TAKEN]).strip(), "%Y:%m:%d %H:%M:%S")
        moment = taken.replace(tzinfo=datetime.strptime(zone, "%z").tzinfo if zone else UTC)
        return moment.timestamp() + (float(f"0.{digits}") if digits.isdigit() else 0.0), bool(zone)
    except Exception:  # as above
        return None


def orientation(photo: Path) -> int:
    """How a photo is turned when displayed, EXIF's 1 to 8; 1: as stored, or unknown."""
    try:
        with _opened(photo) as image:
            value = int(image.getexif().get(ORIENTATION, 1))
    except Exception:  # as above
        return 1
    return value if 1 <= value <= 8 else 1


def device(photo: Path) -> str:
    """Maker, model and lens of the camera, as one text; "" if EXIF doesn't have them."""
    try:
        with _opened(photo) as image:
            tags = image.getexif()
            names = (tags.get(MAKER), tags.get(MODEL), tags.get_ifd(EXIF).get(LENS_MODEL))
        return " ".join(str(name).strip(" \0") for name in names if name)
    except Exception:  # as above
        return ""


def is_equirectangular(photo: Path) -> bool:
    """Whether XMP says that a photo is an equirectangular panorama (https://developers.google.com/streetview/spherical-metadata)."""
    with photo.open("rb") as file:
        return EQUIRECTANGULAR.search(file.read(XMP_BYTES)) is not None


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
