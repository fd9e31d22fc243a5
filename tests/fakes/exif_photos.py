"""Small photos with the EXIF of a phone."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from PIL import Image

from scan2sim.pipeline.io.images import exif


def write(
    path: Path,
    *,
    size: tuple[int, int] = (64, 48),
    position: tuple[float, float, float] | None = None,
    time: float | None = None,
    device: str = "",
    equivalent: int | None = None,
    orientation: int = 1,
) -> Path:
    """Write a grey JPEG photo.

    Args:
        path: file to write.
        size: width and height, pixels.
        position: latitude and longitude (degrees), altitude (m).
        time: UNIX time at which it was taken.
        device: model of the camera.
        equivalent: 35 mm equivalent focal length, mm.
        orientation: how it is turned when displayed (EXIF).
    """
    tags = Image.Exif()
    tags[exif.ORIENTATION] = orientation
    if device:
        tags[exif.MODEL] = device
    own: dict[int, Any] = {}
    if time is not None:
        moment = datetime.fromtimestamp(time, UTC)
        own |= {exif.TAKEN: moment.strftime("%Y:%m:%d %H:%M:%S"), exif.OFFSET: "+00:00"}
    if equivalent is not None:
        own[exif.FOCAL_35MM] = equivalent
    if own:
        tags[exif.EXIF] = own
    if position is not None:
        latitude, longitude, altitude = position
        fixes = {1: "N", 2: _angle(latitude), 3: "E", 4: _angle(longitude), 5: b"\x00", 6: altitude}
        tags[exif.GPS] = fixes
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("L", size, 128).save(path, exif=tags)
    return path


def _angle(value: float) -> tuple[float, float, float]:
    """Degrees, minutes and seconds."""
    return float(int(value)), float(int(value * 60 % 60)), round(value * 3600 % 60, 5)
