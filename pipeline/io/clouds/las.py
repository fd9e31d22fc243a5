"""LAS, LAZ and COPC, through laspy."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator
from dataclasses import replace
from datetime import date
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.errors import DataError, InputError
from scan2sim.pipeline.core.types import F64, Frame, PointCloud
from scan2sim.pipeline.io import file_checks, las_header
from scan2sim.pipeline.io.las_header import truncated

SUFFIXES = (".las", ".laz")
CHUNK = 2_000_000
DAY = date(2000, 1, 1)
"""Of creation, in every header: the same points are the same bytes on every day."""
FEW = 50_000
"""Points at a time, where the first ones mostly tell all; also those of most LAZ files' chunks."""
PLACES, AT_EACH = 24, 500
"""Where in a file, and how many points there, are held against its header's bounds."""
SLACK = 0.1
"""CRS units that points may be outside of their header's bounds, which writers round."""
WIDE = 100.0
"""CRS units by which bounds may be more than twice as wide as a sample of the points."""
SOFTWARE = "scan2sim"
"""Who wrote a file, in its header: codes of 64 and up are of `pipeline.core.classes` then."""


def _open(path: Path, **options: Any) -> Any:
    import laspy

    las_header.check(file_checks.check(path))
    try:
        return laspy.open(path, **options)
    except Exception as error:  # laspy's and the decompressors' parsers raise whatever the damage leads to
        raise InputError(path, f"is no readable LAS file ({error})", las_header.AGAIN) from None


def read_header(path: Path) -> tuple[int, F64, F64, str | None, tuple[str, ...]]:
    """Number of points, low and high corner (CRS units), CRS as WKT or None, and what is wrong with the header.

    The corners are the header's where a sample of the points bears them out, else those of all points.
    """
    with _open(path) as reader:
        header = reader.header
        if header.point_count == 0:
            raise InputError(path, "holds no points", "Leave it out of the tile")
        notes, crs = las_header.check(path), _crs(path, header)
        low, high = np.array(header.mins), np.array(header.maxs)
    if not _borne_out(path, low, high):
        stated = low, high
        stat = path.stat()
        low, high = _bounds(path, stat.st_size, stat.st_mtime_ns)
        if not all(np.allclose(a, b, rtol=0, atol=SLACK) for a, b in zip(stated, (low, high), strict=True)):
            notes = (*notes, "its header's bounding box is not that of its points, which is taken")
    return header.point_count, low, high, crs, notes


def _borne_out(path: Path, low: F64, high: F64) -> bool:
    """Whether the header's corners may be relied on: a sample of the points is within, and not far within."""
    from laspy import LazBackend

    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        return False
    places = []
    with _open(path, laz_backend=LazBackend.Lazrs) as reader:  # decompresses what it is asked for, not whole chunks
        last = reader.header.point_count - AT_EACH
        if last < FEW:  # all are quickly read
            return False
        at = np.linspace(0, last, PLACES).astype(int)
        if reader.header.are_points_compressed:
            at = np.unique(at // FEW * FEW)
        try:
            for first in at.tolist():
                reader.seek(first)
                places.append(_places(reader.read_points(AT_EACH)))
        except Exception:  # no table of chunks, or damage, which reading all of it will name
            return False
    sample = np.concatenate(places)
    least, most = sample.min(axis=0), sample.max(axis=0)
    within = (least >= low - SLACK).all() and (most <= high + SLACK).all()
    return bool(within and (high - low <= 2 * (most - least) + WIDE).all())


@functools.lru_cache(maxsize=256)
def _bounds(path: Path, size: int, changed: int) -> tuple[F64, F64]:
    """Low and high corner of all points of a file of that size and time of change."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    with _open(path) as reader:
        for part in _parts(path, reader, CHUNK):
            places = _places(part)
            low, high = np.minimum(low, places.min(axis=0)), np.maximum(high, places.max(axis=0))
    return low, high


def read(path: Path, frame: Frame) -> PointCloud:
    """Read all points into local coordinates, chunk by chunk; colours of 16 bits become 8."""
    with _open(path) as reader:
        n = reader.header.point_count
        names = set(reader.header.point_format.dimension_names)
        try:
            xyz = np.empty((n, 3), np.float32)
            classification = np.empty(n, np.uint8)
            intensity = np.empty(n, np.uint16)
            time = np.empty(n, np.float64) if "gps_time" in names else None
            rgb = np.empty((n, 3), np.uint16) if "red" in names else None
        except (MemoryError, ValueError):
            raise InputError(path, f"says that it holds {n:,} points: more than fit here", "Cut it first") from None
        at = 0
        for part in _parts(path, reader, CHUNK):
            here = slice(at, at + len(part))
            xyz[here] = frame.to_local(_places(part))
            classification[here] = part.classification
            intensity[here] = part.intensity
            if time is not None:
                time[here] = part.gps_time
            if rgb is not None:
                rgb[here] = _colours(part)
            at += len(part)
    if time is not None and not time.any():  # a format with times that were never filled
        time = None
    return PointCloud(frame, xyz, _eight_bits(rgb), classification=classification, time=time, intensity=intensity)


def class_names(path: Path) -> tuple[bool, dict[int, str]]:
    """Whether this project wrote a file, and what its lookup record calls its classes."""
    with _open(path) as reader:
        header = reader.header
        writers = f"{header.system_identifier} {header.generating_software}".lower()
        names = {c: n for record in header.vlrs.get("ClassificationLookupVlr") for c, n in record.lookups.items()}
    return SOFTWARE in writers, names


def records(path: Path, size: int = CHUNK) -> Iterator[Any]:
    """The points as laspy's records, `size` at a time.

    Raises:
        InputError: missing, truncated or damaged.
    """
    with _open(path) as reader:
        yield from _parts(path, reader, size)


def chunks(path: Path, frame: Frame, size: int = CHUNK) -> Iterator[PointCloud]:
    """The points in their order, `size` at a time, as `read` reads them.

    Each part is in a frame of its own, with its origin near its points: over kilometres float32 would lose
    millimetres.
    """
    shift = _colour_shift(path)
    with _open(path) as reader:
        timed = "gps_time" in set(reader.header.point_format.dimension_names)
        for part in _parts(path, reader, size):
            places = _places(part)
            x, y, z = np.floor(places.mean(axis=0) * frame.unit).tolist()
            near = replace(frame, origin=(x, y, z))
            yield PointCloud(
                near,
                near.to_local(places).astype(np.float32),
                None if shift is None else (_colours(part) >> shift).astype(np.uint8),
                classification=np.array(part.classification, np.uint8),
                time=np.array(part.gps_time, np.float64) if timed else None,
                intensity=np.array(part.intensity, np.uint16),
            )


def write(path: Path, cloud: PointCloud, scale: float = 0.001) -> None:
    """Write a LAS 1.4 file (LAZ by suffix), CRS and class names included; coordinates back in the CRS."""
    write_parts(path, [cloud], scale)


def write_parts(path: Path, parts: Iterable[PointCloud], scale: float = 0.001, software: str = SOFTWARE) -> None:
    """Write what `write` would of all parts together, which are in one frame and have the same attributes.

    Args:
        parts: at least one; only one at a time is in memory.
        scale: metres, the precision of coordinates.
        software: that classes are of; another than `SOFTWARE` where they are as a survey has them.
    """
    import laspy

    rest = iter(parts)
    first = next(rest)
    header = _header(first, scale)
    header.generating_software = software
    with laspy.open(path, mode="w", header=header) as writer:
        for part in chain([first], rest):
            try:
                writer.write_points(_record(part, header))
            except OverflowError:
                reach = 2**31 * scale / 1000
                cause = f"its points are more than {reach:,.0f} km apart: LAS holds no more in steps of {scale:g} m"
                raise DataError(path.name, cause, "Remove stray points, and check the unit") from None


def _header(cloud: PointCloud, scale: float) -> Any:
    import laspy
    from laspy.vlrs.known import WktCoordinateSystemVlr

    header = laspy.LasHeader(point_format=6 if cloud.rgb is None else 7, version="1.4")
    header.creation_date = DAY
    header.scales = np.full(3, scale / cloud.frame.unit)
    header.offsets = np.floor(cloud.frame.to_crs(np.zeros(3)))
    if cloud.frame.crs != "local":
        from pyproj import CRS

        header.vlrs.append(WktCoordinateSystemVlr(CRS.from_user_input(cloud.frame.crs).to_wkt("WKT1_GDAL")))
        header.global_encoding.wkt = True
    return header


def _record(cloud: PointCloud, header: Any) -> Any:
    import laspy

    record = laspy.ScaleAwarePointRecord.zeros(len(cloud), header=header)
    record["x"], record["y"], record["z"] = cloud.frame.to_crs(cloud.xyz).T
    if cloud.classification is not None:
        record["classification"] = cloud.classification
    if cloud.time is not None:
        record["gps_time"] = cloud.time
    if cloud.intensity is not None:
        record["intensity"] = cloud.intensity
    if cloud.rgb is not None:
        record["red"], record["green"], record["blue"] = (cloud.rgb.astype(np.uint16) * 257).T
    return record


def _parts(path: Path, reader: Any, size: int) -> Iterator[Any]:
    """All points of an open file, `size` at a time, in laspy's records; less than all is an error."""
    at, n = 0, reader.header.point_count
    try:
        for part in reader.chunk_iterator(size):
            yield part
            at += len(part)
    except Exception as error:  # the decompressors raise their own kinds, a panic among them
        raise truncated(path, at, n, str(error)) from None
    if at < n:
        raise truncated(path, at, n, "end of file")


def _places(part: Any) -> F64:
    """(N, 3) CRS coordinates of a record."""
    return np.column_stack([part.x, part.y, part.z])


def _colours(part: Any) -> Any:
    """(N, 3) uint16 of a record."""
    return np.column_stack([part.red, part.green, part.blue])


def _colour_shift(path: Path) -> int | None:
    """By how many bits colours must be shifted to be of 8; None without any. Mostly the first points tell it."""
    with _open(path) as reader:
        if "red" not in set(reader.header.point_format.dimension_names):
            return None
        filled = False
        for part in _parts(path, reader, FEW):
            most = _colours(part).max()
            if most > 255:
                return 8
            filled |= bool(most)
    return 0 if filled else None


def _eight_bits(rgb: Any) -> Any:
    if rgb is None or not rgb.any():  # a format with colour fields that were never filled
        return None
    return (rgb >> 8).astype(np.uint8) if rgb.max() > 255 else rgb.astype(np.uint8)


def _crs(path: Path, header: Any) -> str | None:
    try:
        crs = las_header.parsed_crs(header)
    except ValueError as error:
        raise InputError(
            path, f"its CRS can't be read ({error})", "Set `crs` in its header, or write it again"
        ) from None
    return crs.to_wkt() if crs is not None else None
