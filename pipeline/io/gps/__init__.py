"""GPS track readers: one module per format (`pipeline.core.plugins`), selected by the file's suffix.

A format's module has `SUFFIXES` and `read(path) -> GpsTrack`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.errors import from_os_error
from scan2sim.pipeline.core.optional_deps import require
from scan2sim.pipeline.core.types import GpsTrack
from scan2sim.pipeline.io import file_checks, foreign_files


class Format(Protocol):
    """Interface of a format's module.

    Attributes:
        SUFFIXES: suffixes of its files.
    """

    SUFFIXES: tuple[str, ...]

    def read(self, path: Path) -> GpsTrack:
        """See `read`."""


def read(path: Path) -> GpsTrack:
    """Read and clean a track: sorted, each time once, without poor fixes and outliers.

    Times are UNIX seconds for GPX and NMEA, the file's own for CSV, and seconds of the video for a GoPro video.

    Raises:
        InputError: unreadable, or without a usable fix.
        ScanError: as `reader`.
    """
    found = reader(path)
    try:
        return found.read(path)
    except OSError as error:
        raise from_os_error(error, path) from error


def reader(path: Path) -> Format:
    """The format module for a track; the track isn't read yet.

    Raises:
        InputError: the file doesn't exist, or its suffix is unknown.
        UnavailableError: it is a video, and PyAV isn't installed.
    """
    formats = plugins.by_suffix(__name__)
    name = formats.get(path.suffix.lower())
    if name is None:
        raise foreign_files.unread(path, "has an unknown GPS format", f"Use one of {', '.join(formats)}")
    file_checks.check(path)
    found: Format = plugins.module(__name__, name)
    require(str(path), *plugins.needs(found))
    return found
