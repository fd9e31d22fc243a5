"""Approximate positions of photos: by the GPS in their EXIF, by a GPS track and their times, or by a list."""

from __future__ import annotations

import unicodedata
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import DataError, InputError
from scan2sim.pipeline.core.types import F64, GpsTrack
from scan2sim.pipeline.importers import georeference
from scan2sim.pipeline.io import gps as gps_io
from scan2sim.pipeline.io import tables
from scan2sim.pipeline.io.geodata import crs as crs_io
from scan2sim.pipeline.io.images import exif
from scan2sim.slam.reconstruction.photos import Photo, list_photos, read_headers, with_times
from scan2sim.slam.trajectory.gps import ABSOLUTE_S, ZONES_S, smooth, video_clock
from scan2sim.slam.video import open_video

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
    offset: float | None = None,
) -> bool:
    """Whether the photos of a folder or video have approximate positions; fast, before they are reconstructed.

    Args:
        source: folder of photos, or a video.
        gps, times, positions: files, if given.
        cloud: cloud that the photos are aligned with, if any.
        crs: its CRS, or that of the result; None: unknown.
        offset: seconds to add to the track's times; None: by the clocks.

    Raises:
        ScanError: the files can't be read or don't fit the photos, or there are none although there is a cloud.
    """
    if gps is not None:
        geographic = gps_io.read(gps).frame.crs != crs_io.LOCAL
    elif positions is not None:
        geographic = False
        _check_list(positions, source)
    else:
        geographic = _located(source, cloud)
        if not geographic:
            return False
    if cloud is not None and geographic and crs in (None, crs_io.LOCAL):
        raise DataError(
            cloud, "has no CRS, so GPS can't locate photos in it",
            f"Give its CRS (--crs EPSG:32633), or {POSITIONS}",
        )  # fmt: skip
    if gps is not None:
        _check_track(gps, source, times, offset)
    return True


def _located(source: Path, cloud: Path | None) -> bool:
    """Whether photos have GPS in their EXIF.

    Raises:
        DataError: they don't, and there is a cloud.
    """
    names = list_photos(source) if source.is_dir() else []
    located = 0
    for name in names:
        located += exif.gps_position(source / name) is not None
        if located >= MIN_POSITIONS:
            return True
    if cloud is None:
        return False
    what = "a video has no GPS of its own" if not source.is_dir() else f"{located} of its photos have GPS"
    raise DataError(source, f"{what}: it is unknown where in {cloud.name} they were taken", NEEDED)


def _check_track(gps: Path, source: Path, times: Path | None, offset: float | None) -> None:
    """Raise a ScanError if a track doesn't cover the times of photos, or of a video of known length."""
    if source.is_dir():
        photos = read_headers(source)
        by_track(gps, photos if times is None else with_times(photos, list_photos(source), times), None, None, offset)
        return
    video = open_video(source)
    seconds = range(int((video.count or 0) / video.fps) + 1) if video.fps else range(0)
    if len(seconds) >= MIN_POSITIONS:
        frames = [Photo(f"{second} s", video.width, video.height, time=float(second)) for second in seconds]
        by_track(gps, frames, None, video.start, offset)


def _check_list(path: Path, source: Path) -> None:
    """Raise an InputError if a list can't be read, or names photos that aren't in the folder `source`."""
    listed = _read_list(path)
    known = {_plain(name) for name in list_photos(source)} if source.is_dir() else set(listed)
    unknown = [name for name in listed if name not in known]
    if unknown:
        cause = f"names {', '.join(unknown[:3])}, which {source.name} doesn't have"
        raise InputError(path, cause, "Write the names as in the folder, with subfolders (left/1.jpg)")
    if len(listed) < MIN_POSITIONS:
        cause = f"has positions of {len(listed)} photos"
        raise InputError(path, cause, f"Give those of at least {MIN_POSITIONS}, far from each other")


def _read_list(path: Path) -> dict[str, list[float]]:
    """Coordinates by name of a CSV file with the columns file, x, y, z.

    Raises:
        InputError: it can't be read.
    """
    table = tables.read(path)
    table.require(("file", *"xyz"))
    found = {}
    for number, line in table.rows:
        try:
            found[_plain(line["file"])] = [float(line[axis].replace(",", ".")) for axis in "xyz"]
        except ValueError as error:
            raise InputError(path, f"row {number}: {error}", "Write a header line file,x,y,z") from None
    return found


def _plain(name: str) -> str:
    """A photo's name with slashes, and in the same Unicode form on all systems."""
    return unicodedata.normalize("NFC", name.replace("\\", "/"))


def by_list(path: Path, photos: Sequence[Photo], crs: str) -> Positions:
    """Positions by a CSV file with the columns file, x, y, z in the units of the CRS; other photos are ignored.

    Raises:
        InputError: it can't be read, or names none of the photos.
    """
    _, unit = crs_io.common(path, crs, None, (), ())
    xyz = np.full((len(photos), 3), np.nan)
    rows = {_plain(photo.name): i for i, photo in enumerate(photos)}
    listed = _read_list(path)
    others = [name for name in listed if name not in rows]
    for name, position in listed.items():
        if name in rows:
            xyz[rows[name]] = position
    notes = () if not others else (f"{path.name} has positions of photos without a pose: {', '.join(others[:3])}",)
    if len(others) == len(listed):
        raise InputError(path, f"names {', '.join(others[:3])}, which have no pose", "Name other photos")
    return Positions(xyz * unit, crs, unit, notes)


def by_exif(source: Path, photos: Sequence[Photo], crs: str | None) -> Positions:
    """Positions by EXIF in a CRS (default: UTM).

    Raises:
        DataError: fewer than three photos have GPS. InputError: they are outside of the area of the CRS.
    """
    try:
        found, xyz, unit, notes = georeference.photo_positions(source, [source / photo.name for photo in photos], crs)
    except DataError as error:
        raise DataError(source, error.cause, NEEDED) from None
    return Positions(xyz, found, unit, tuple(notes))


def by_track(
    path: Path, photos: Sequence[Photo], crs: str | None, start: float | None, offset: float | None
) -> Positions:
    """Positions by a GPS track at the photos' times.

    Args:
        path: track.
        photos: photos; those without a time have no position.
        crs: CRS of the result; default: that of the track.
        start: UNIX time of a video's first frame, if known.
        offset: seconds to add to the track's times; None: by the clocks.

    Raises:
        DataError: fewer than three photos have times, or the clocks can't be compared.
        ScanError: the track can't be read.
    """
    notes: list[str] = []
    timed = [i for i, photo in enumerate(photos) if photo.time is not None]
    if len(timed) < MIN_POSITIONS:
        raise _untimed(path, next(photo.name for photo in photos if photo.time is None))
    times = np.array([photos[i].time for i in timed], np.float64)
    zoned = all(photos[i].zoned for i in timed)
    track = shifted(gps_io.read(path), times, path, start, offset, zoned, notes.append)
    xyz = np.full((len(photos), 3), np.nan)
    xyz[timed] = smooth(track).at(times, MAX_GAP_S)
    known = int(np.isfinite(xyz[:, 0]).sum())
    if known < MIN_POSITIONS:
        raise DataError(
            path, f"covers the times of {known} of {len(photos)} photos only",
            "Check --times and --gps-offset (seconds to add to the track's times)",
        )  # fmt: skip
    if len(timed) < len(photos):
        notes.append(f"{len(photos) - len(timed)} photos have no time, so {path.name} doesn't locate them")
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
