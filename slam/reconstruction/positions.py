"""Approximate positions of photos: by the GPS in their EXIF, by a GPS track and their times, or by a list."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import DataError, InputError
from scan2sim.pipeline.core.types import F64, GpsTrack
from scan2sim.pipeline.importers import georeference
from scan2sim.pipeline.io import file_checks, tables
from scan2sim.pipeline.io import gps as gps_io
from scan2sim.pipeline.io.geodata import crs as crs_io
from scan2sim.pipeline.io.images import exif
from scan2sim.slam.reconstruction.photos import Photo, list_photos
from scan2sim.slam.trajectory.gps import ABSOLUTE_S, ZONES_S, smooth, video_clock

MAX_GAP_S = 10.0
"""Gap of a GPS track up to which positions are interpolated."""
MIN_POSITIONS = 3
POSITIONS = "--positions FILE: a CSV file,x,y,z with rough positions of 3 photos or more in the cloud's coordinates"
NEEDED = f"Give --gps TRACK (GPX, NMEA, CSV), photos with GPS in their EXIF, or {POSITIONS}"


@dataclass(frozen=True)
class Positions:
    """Approximate positions.

    Attributes:
        xyz: (P, 3) metres along the axes of the CRS; NaN where unknown.
        crs: their CRS, or "local".
        unit: metres per unit of the CRS.
        notes: messages for the user.
    """

    xyz: F64
    crs: str
    unit: float = 1.0
    notes: tuple[str, ...] = ()


def check_sources(
    source: Path,
    *,
    gps: Path | None = None,
    times: Path | None = None,
    positions: Path | None = None,
    cloud: Path | None = None,
    crs: str | None = None,
) -> bool:
    """Whether the photos of a folder or video have approximate positions; fast, before they are reconstructed.

    Args:
        source: folder of photos, or a video.
        gps, times, positions: files, if given.
        cloud: cloud that the photos are aligned with, if any.
        crs: its CRS, or that of the result; None: unknown.

    Raises:
        ScanError: the files can't be read, or there are none although there is a cloud.
    """
    if gps is not None:
        geographic = gps_io.read(gps).frame.crs != crs_io.LOCAL
        names = list_photos(source) if source.is_dir() and times is None else []
        if names and not any(exif.time_taken(source / name) for name in names):
            raise _untimed(gps, names[0])
    elif positions is not None:
        file_checks.check(positions)
        geographic = False
    else:
        names = list_photos(source) if source.is_dir() else []
        located = 0
        for name in names:
            located += exif.gps_position(source / name) is not None
            if located >= MIN_POSITIONS:
                break
        if located < MIN_POSITIONS:
            if cloud is None:
                return False
            what = "a video has no GPS of its own" if not source.is_dir() else f"{located} of its photos have GPS"
            raise DataError(source, f"{what}: it is unknown where in {cloud.name} they were taken", NEEDED)
        geographic = True
    if cloud is not None and geographic and crs in (None, crs_io.LOCAL):
        raise DataError(
            cloud, "has no CRS, so GPS can't locate photos in it",
            f"Give its CRS (--crs EPSG:32633), or {POSITIONS}",
        )  # fmt: skip
    return True


def by_list(path: Path, photos: Sequence[Photo], crs: str) -> Positions:
    """Positions by a CSV file with the columns file, x, y, z in the units of the CRS.

    Raises:
        InputError: it can't be read, or names unknown photos.
    """
    _, unit = crs_io.common(path, crs, None, (), ())
    xyz = np.full((len(photos), 3), np.nan)
    rows = {photo.name: i for i, photo in enumerate(photos)}
    table = tables.read(path)
    table.require(("file", *"xyz"))
    for number, line in table.rows:
        name = line["file"].replace("\\", "/")
        if name not in rows:
            raise InputError(path, f"names {name}, which has no pose", "Name other photos, as in the folder")
        try:
            xyz[rows[name]] = [float(line[axis].replace(",", ".")) for axis in "xyz"]
        except ValueError as error:
            raise InputError(path, f"row {number}: {error}", "Write a header line file,x,y,z") from None
    return Positions(xyz * unit, crs, unit)


def by_exif(source: Path, photos: Sequence[Photo], crs: str | None) -> Positions:
    """Positions by EXIF in a CRS (default: UTM).

    Raises:
        ScanError: as `pipeline.importers.georeference.photo_positions`.
    """
    found, xyz, unit, notes = georeference.photo_positions(source, [source / photo.name for photo in photos], crs)
    return Positions(xyz, found, unit, tuple(notes))


def by_track(
    path: Path, photos: Sequence[Photo], crs: str | None, start: float | None, offset: float | None
) -> Positions:
    """Positions by a GPS track at the photos' times.

    Args:
        path: track.
        photos: photos with times.
        crs: CRS of the result; default: that of the track.
        start: UNIX time of a video's first frame, if known.
        offset: seconds to add to the track's times; None: by the clocks.

    Raises:
        DataError: photos have no times, or the clocks can't be compared.
        ScanError: the track can't be read.
    """
    notes: list[str] = []
    if any(photo.time is None for photo in photos):
        raise _untimed(path, next(photo.name for photo in photos if photo.time is None))
    times = np.array([photo.time for photo in photos], np.float64)
    zoned = all(photo.zoned for photo in photos)
    track = shifted(gps_io.read(path), times, path, start, offset, zoned, notes.append)
    xyz = smooth(track).at(times, MAX_GAP_S)
    known = int(np.isfinite(xyz[:, 0]).sum())
    if known < MIN_POSITIONS:
        raise DataError(
            path, f"covers the times of {known} of {len(photos)} photos only",
            "Check --times and --gps-offset (seconds to add to the track's times)",
        )  # fmt: skip
    own = track.frame
    if own.crs == crs_io.LOCAL or crs is None or crs_io.same(own.crs, crs):
        target = crs or own.crs
        _, unit = crs_io.common(path, target, None, (), ())
        return Positions(xyz + own.origin, target, unit, tuple(notes))
    from pyproj import Transformer

    _, unit = crs_io.common(path, crs, None, (), ())
    east, north, height = own.to_crs(xyz).T
    x, y = Transformer.from_crs(own.crs, crs, always_xy=True).transform(east, north)
    moved = np.column_stack([np.asarray(x) * unit, np.asarray(y) * unit, height])
    moved[~np.isfinite(moved).all(axis=1)] = np.nan
    return Positions(moved, crs, unit, tuple(notes))


def _untimed(track: Path, photo: str) -> DataError:
    return DataError(
        track, f"can't be compared with the photos: {photo} has no time in its EXIF",
        "Give --times FILE: seconds, one line per photo",
    )  # fmt: skip


def shifted(
    track: GpsTrack,
    times: F64,
    path: Path,
    start: float | None,
    offset: float | None,
    zoned: bool,
    warn: Callable[[str], None],
) -> GpsTrack:
    """The track in the photos' times; arguments as of `by_track`.

    Raises:
        DataError: the clocks can't be compared.
    """
    if offset is not None:
        return track.shifted(offset)
    from_1970, photos_from_1970 = track.times[0] > ABSOLUTE_S, times.min() > ABSOLUTE_S
    if from_1970 and not photos_from_1970:
        if start is not None:
            return video_clock(track, start, warn)
        warn("the first photo is assumed to be taken at the first GPS fix (see --gps-offset)")
        return track.shifted(times.min() - float(track.times[0]))
    if photos_from_1970 and not from_1970:
        raise DataError(path, "counts its times from 0, but the photos have dates", "Give --gps-offset, or --times")
    if not photos_from_1970 or zoned:
        return track
    zones = ZONES_S
    inside = [((times >= track.times[0] + z) & (times <= track.times[-1] + z)).mean() for z in zones]
    best = np.flatnonzero(np.array(inside) == max(inside))
    if max(inside) < 0.5 or len(best) > 1:
        raise DataError(path, "the time zone of the photos' clock is unknown", "Give --gps-offset (seconds)")
    if zones[best[0]]:
        warn(f"the photos' clock is assumed to be {zones[best[0]] / 3600:+g} h from UTC (see --gps-offset)")
    return track.shifted(float(zones[best[0]]))
