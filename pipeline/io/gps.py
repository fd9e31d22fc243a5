"""GPS tracks: one module a format, found by the file's suffix; each has `read(path) -> GpsTrack`."""

from __future__ import annotations

import importlib
from pathlib import Path

from scan2sim.pipeline.errors import InputError, from_os_error
from scan2sim.pipeline.io import files
from scan2sim.pipeline.types import GpsTrack

FORMATS = {
    ".gpx": "gpx", ".csv": "gps_csv", ".nmea": "nmea", ".txt": "nmea", ".log": "nmea",
    ".mp4": "gopro", ".mov": "gopro", ".360": "gopro", ".lrv": "gopro",
}  # fmt: skip
"""Suffixes of tracks, and the modules of `pipeline.io` that read them."""


def read(path: Path) -> GpsTrack:
    """Read and tidy a track: sorted, each time once, without bad fixes and jumps.

    Times are UNIX seconds for GPX and NMEA, as the file says for CSV, and for a GoPro video seconds of the video.

    Raises:
        InputError: unknown suffix, unreadable, or no fix in it.
        UnavailableError: a video, and PyAV isn't installed.
    """
    name = FORMATS.get(path.suffix.lower())
    if name is None:
        raise InputError(path, "is no known GPS format", f"Give one of {', '.join(FORMATS)}")
    files.check(path)
    try:
        track: GpsTrack = importlib.import_module(f"scan2sim.pipeline.io.{name}").read(path)
        return track
    except OSError as error:
        raise from_os_error(error, path) from error
