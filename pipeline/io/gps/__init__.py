"""GPS tracks: a file a format (`pipeline.core.plugins`), found by the track's suffix.

A format's module has `SUFFIXES` and `read(path) -> GpsTrack`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.errors import InputError, from_os_error
from scan2sim.pipeline.core.optional_deps import need
from scan2sim.pipeline.core.types import GpsTrack
from scan2sim.pipeline.io import file_checks


class Format(Protocol):
    """What a format's module has.

    Attributes:
        SUFFIXES: of its files.
    """

    SUFFIXES: tuple[str, ...]

    def read(self, path: Path) -> GpsTrack:
        """See `read`."""


def read(path: Path) -> GpsTrack:
    """Read and tidy a track: sorted, each time once, without bad fixes and jumps.

    Times are UNIX seconds for GPX and NMEA, as the file says for CSV, and for a GoPro video seconds of the video.

    Raises:
        InputError: unreadable, or no fix in it.
        ScanError: as `reader`.
    """
    found = reader(path)
    try:
        return found.read(path)
    except OSError as error:
        raise from_os_error(error, path) from error


def reader(path: Path) -> Format:
    """What reads a track; the track itself isn't read.

    Raises:
        InputError: there is no such file, or its suffix is unknown.
        UnavailableError: a video, and PyAV isn't installed.
    """
    formats = plugins.by_suffix(__name__)
    name = formats.get(path.suffix.lower())
    if name is None:
        raise InputError(path, "is no known GPS format", f"Give one of {', '.join(formats)}")
    file_checks.check(path)
    found: Format = plugins.module(__name__, name)
    need(str(path), *plugins.needs(found))
    return found
