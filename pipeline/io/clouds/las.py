"""LAS, LAZ and COPC clouds, read and written with laspy.

Points with the withheld flag are not read: they "should not be included in processing" (LAS 1.4 R15, table 9).
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from datetime import date
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from scan2sim.pipeline.core.errors import DataError, InputError
from scan2sim.pipeline.core.types import F64, U8, Bools, Frame, PointCloud
from scan2sim.pipeline.io import file_checks, las_header
from scan2sim.pipeline.io.las_header import truncated

SUFFIXES = (".las", ".laz")
CHUNK_POINTS = 2_000_000
CREATION_DATE = date(2000, 1, 1)
"""Constant creation date in every header, so that the same points always give the same bytes."""
PROBE_POINTS = 50_000
"""Points per read where the first read mostly suffices; also the chunk size of most LAZ files."""
SAMPLE_POSITIONS, SAMPLE_POINTS = 24, 500
"""Positions in a file that are sampled to check its header's bounds, and points read at each."""
BOUNDS_TOLERANCE = 0.1
"""CRS units by which points may be outside of the header's bounds, which writers round."""
BOUNDS_MARGIN = 100.0
"""CRS units by which the header's bounds may exceed twice the extent of the sampled points."""
SOFTWARE = "scan2sim"
"""Generating software in the header of files of this project: codes from 64 on are `pipeline.core.classes` then."""


class Flags(NamedTuple):
    """Number of points with the withheld flag (not read), and of others with the overlap flag (read)."""

    withheld: int
    overlap: int


def open_las(path: Path, **options: Any) -> Any:
    """Open a file with laspy after checking its header.

    Raises:
        InputError: missing, or not a readable LAS file.
    """
    import laspy

    las_header.check(file_checks.check(path))
    try:
        return laspy.open(path, **options)
    except Exception as error:  # damaged files make laspy and the decompressors raise any type of exception
        raise InputError(path, f"is not a readable LAS file ({error})", las_header.COPY_AGAIN) from None


def read_header(path: Path) -> tuple[int, F64, F64, str | None, tuple[str, ...]]:
    """Number of points, low and high corner (CRS units), CRS as WKT or None, and warnings about the header.

    The corners are the header's if a sample of the points agrees with them, else those of all points.
    """
    with open_las(path) as reader:
        header = reader.header
        if header.point_count == 0:
            raise InputError(path, "contains no points", "Remove it from the tile")
        crs, crs_notes = _crs(header)
        notes = (*las_header.check(path), *crs_notes)
        low, high = np.array(header.mins), np.array(header.maxs)
    if not _bounds_plausible(path, low, high):
        declared = low, high
        stat = path.stat()
        low, high = _bounds(path, stat.st_size, stat.st_mtime_ns)
        if not all(
            np.allclose(a, b, rtol=0, atol=BOUNDS_TOLERANCE) for a, b in zip(declared, (low, high), strict=True)
        ):
            notes = (*notes, "its header's bounding box is wrong: that of the points is used")
    return header.point_count, low, high, crs, notes


def _bounds_plausible(path: Path, low: F64, high: F64) -> bool:
    """Whether the header's corners agree with a sample of the points: they contain it, and aren't much larger."""
    from laspy import LazBackend

    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        return False
    samples = []
    with open_las(path, laz_backend=LazBackend.Lazrs) as reader:  # decompresses only the requested points of a chunk
        last = reader.header.point_count - SAMPLE_POINTS
        if last < PROBE_POINTS:  # reading all points is fast
            return False
        at = np.linspace(0, last, SAMPLE_POSITIONS).astype(int)
        if reader.header.are_points_compressed:
            at = np.unique(at // PROBE_POINTS * PROBE_POINTS)
        try:
            for first in at.tolist():
                reader.seek(first)
                samples.append(_coordinates(reader.read_points(SAMPLE_POINTS)))
        except Exception:  # no chunk table, or damage, which is reported when all points are read
            return False
    sample = np.concatenate(samples)
    sample_low, sample_high = sample.min(axis=0), sample.max(axis=0)
    within = (sample_low >= low - BOUNDS_TOLERANCE).all() and (sample_high <= high + BOUNDS_TOLERANCE).all()
    return bool(within and (high - low <= 2 * (sample_high - sample_low) + BOUNDS_MARGIN).all())


@functools.lru_cache(maxsize=256)
def _bounds(path: Path, size: int, modified_ns: int) -> tuple[F64, F64]:
    """Low and high corner of all points of a file; size and modification time are the cache key."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    with open_las(path) as reader:
        for part in read_parts(path, reader, CHUNK_POINTS):
            xyz = _coordinates(part)
            low, high = np.minimum(low, xyz.min(axis=0)), np.maximum(high, xyz.max(axis=0))
    return low, high


def read(path: Path, frame: Frame) -> PointCloud:
    """Read all points but withheld ones into local coordinates, chunk by chunk; 16-bit colours become 8-bit ones."""
    with open_las(path) as reader:
        n = reader.header.point_count
        names = set(reader.header.point_format.dimension_names)
        try:
            xyz = np.empty((n, 3), np.float32)
            classification = np.empty(n, np.uint8)
            intensity = np.empty(n, np.uint16)
            time = np.empty(n, np.float64) if "gps_time" in names else None
            rgb = np.empty((n, 3), np.uint16) if "red" in names else None
        except (MemoryError, ValueError):
            cause = f"declares {n:,} points, which don't fit into memory"
            raise InputError(path, cause, "Cut it into smaller files first") from None
        at = 0
        for part in _used_parts(path, reader, CHUNK_POINTS):
            rows = slice(at, at + len(part))
            xyz[rows] = frame.to_local(_coordinates(part))
            classification[rows] = part.classification
            intensity[rows] = part.intensity
            if time is not None:
                time[rows] = part.gps_time
            if rgb is not None:
                rgb[rows] = _colours(part)
            at += len(part)
    cloud = PointCloud(
        frame,
        xyz[:at],
        None if rgb is None else _to_uint8(rgb[:at]),
        classification=classification[:at],
        time=None if time is None or not np.nan_to_num(time[:at]).any() else time[:at],  # None: never filled
        intensity=intensity[:at],
    )
    return cloud


def flags(path: Path) -> Flags:
    """Count the points that have flags; decompresses the file's flags.

    Raises:
        InputError: missing, truncated or damaged.
    """
    stat = path.stat()
    return _count_flags(path, stat.st_size, stat.st_mtime_ns)


@functools.lru_cache(maxsize=256)
def _count_flags(path: Path, size: int, modified_ns: int) -> Flags:
    """`flags` of a file; size and modification time are the cache key."""
    from laspy import DecompressionSelection

    wanted = DecompressionSelection.XY_RETURNS_CHANNEL | DecompressionSelection.FLAGS
    withheld = overlap = 0
    with open_las(path, decompression_selection=wanted) as reader:
        has_overlap = "overlap" in set(reader.header.point_format.dimension_names)
        for part in read_parts(path, reader, CHUNK_POINTS):
            used = in_use(part)
            withheld += int(np.count_nonzero(~used))
            overlap += int(np.count_nonzero(np.asarray(part.overlap)[used])) if has_overlap else 0
    return Flags(withheld, overlap)


def used_and_classes(path: Path) -> tuple[Bools, U8]:
    """Whether each of a file's points is used (not withheld), (N,) bool, and its class code, (N,) uint8.

    Raises:
        InputError: missing, truncated or damaged.
    """
    parts = [(in_use(part), np.array(part.classification, np.uint8)) for part in records(path)]
    return np.concatenate([used for used, _ in parts]), np.concatenate([codes for _, codes in parts])


def in_use(part: Any) -> Bools:
    """(N,) whether the points of a record don't have the withheld flag."""
    return np.asarray(part.withheld) == 0


def class_names(path: Path) -> tuple[bool, dict[int, str]]:
    """Whether this project wrote a file, and the class names of its classification lookup record."""
    with open_las(path) as reader:
        header = reader.header
        writers = f"{header.system_identifier} {header.generating_software}".lower()
        names = {c: n for record in header.vlrs.get("ClassificationLookupVlr") for c, n in record.lookups.items()}
    return SOFTWARE in writers, names


def records(path: Path, size: int = CHUNK_POINTS) -> Iterator[Any]:
    """The points as laspy records, `size` at a time.

    Raises:
        InputError: missing, truncated or damaged.
    """
    with open_las(path) as reader:
        yield from read_parts(path, reader, size)


def chunks(path: Path, frame: Frame, size: int = CHUNK_POINTS) -> Iterator[PointCloud]:
    """The points but withheld ones in file order, at most `size` at a time, converted as by `read`.

    Each chunk is in a frame of its own, with its origin near its points: over kilometres float32 would lose
    millimetres.
    """
    shift = _colour_shift(path)
    with open_las(path) as reader:
        timed = "gps_time" in set(reader.header.point_format.dimension_names)
        for part in _used_parts(path, reader, size):
            xyz = _coordinates(part)
            x, y, z = np.floor(xyz.mean(axis=0) * frame.unit).tolist()
            near = replace(frame, origin=(x, y, z))
            yield PointCloud(
                near,
                near.to_local(xyz).astype(np.float32),
                None if shift is None else (_colours(part) >> shift).astype(np.uint8),
                classification=np.array(part.classification, np.uint8),
                time=np.array(part.gps_time, np.float64) if timed else None,
                intensity=np.array(part.intensity, np.uint16),
            )


def write(path: Path, cloud: PointCloud, scale: float = 0.001) -> None:
    """Write a LAS 1.4 file (LAZ by suffix) with its CRS; coordinates are transformed back to the CRS."""
    write_parts(path, [cloud], scale)


def write_parts(path: Path, parts: Iterable[PointCloud], scale: float = 0.001, software: str = SOFTWARE) -> None:
    """Write chunks of one cloud, in the same frame and with the same attributes, as one file like `write`.

    Args:
        path: LAS or LAZ file.
        parts: at least one chunk; only one at a time is in memory.
        scale: resolution of the coordinates, metres.
        software: generating software; not `SOFTWARE` if class codes are those of the survey.
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
                extent_km = 2**31 * scale / 1000
                cause = (
                    f"its points are more than {extent_km:,.0f} km apart, LAS's limit at a resolution of {scale:g} m"
                )
                raise DataError(path.name, cause, "Remove outliers, and check the unit") from None


def rewrite(path: Path, out: Path, moved: Callable[[F64, F64], F64]) -> None:
    """Write a file with other coordinates; all attributes, the CRS and other records of the header remain.

    Args:
        path: file with GPS times.
        out: LAS or LAZ file to write.
        moved: function of coordinates (N, 3), CRS units, and times (N,) that returns new coordinates.

    Raises:
        InputError: missing, truncated or damaged.
    """
    import laspy

    with open_las(path) as reader:
        header = laspy.LasHeader(version=reader.header.version, point_format=reader.header.point_format)
        header.scales, header.offsets = reader.header.scales, reader.header.offsets
        header.vlrs.extend(vlr for vlr in reader.header.vlrs if vlr.user_id not in ("copc", "laszip encoded"))
        header.global_encoding = reader.header.global_encoding
        header.system_identifier = reader.header.system_identifier
        header.generating_software = reader.header.generating_software
        header.creation_date = reader.header.creation_date
        with laspy.open(out, mode="w", header=header) as writer:
            for part in read_parts(path, reader, CHUNK_POINTS):
                xyz = moved(_coordinates(part), np.asarray(part.gps_time, np.float64))
                part.x, part.y, part.z = xyz.T
                writer.write_points(part)


def _header(cloud: PointCloud, scale: float) -> Any:
    import laspy
    from laspy.vlrs.known import WktCoordinateSystemVlr

    header = laspy.LasHeader(point_format=6 if cloud.rgb is None else 7, version="1.4")
    header.creation_date = CREATION_DATE
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


def read_parts(path: Path, reader: Any, size: int) -> Iterator[Any]:
    """All points of an open file, `size` at a time, as laspy records.

    Raises:
        InputError: the file has fewer points than its header declares.
    """
    at, n = 0, reader.header.point_count
    try:
        for part in reader.chunk_iterator(size):
            yield part
            at += len(part)
    except Exception as error:  # the decompressors raise types of their own, Rust panics among them
        raise truncated(path, at, n, str(error)) from None
    if at < n:
        raise truncated(path, at, n, "end of file")


def _used_parts(path: Path, reader: Any, size: int) -> Iterator[Any]:
    """The points of an open file that aren't withheld, at most `size` at a time, as laspy records.

    Raises:
        InputError: as `read_parts`, or all points are withheld.
    """
    found = False
    for part in read_parts(path, reader, size):
        used = in_use(part)
        if used.any():
            found = True
            yield part if used.all() else part[used]
    if not found:
        cause = f"all of its {reader.header.point_count:,} points have the withheld flag (not to be used)"
        raise InputError(path, cause, "Clear the flag in the program that set it, or leave the file out")


def _coordinates(part: Any) -> F64:
    """CRS coordinates (N, 3) of a record."""
    return np.column_stack([part.x, part.y, part.z])


def _colours(part: Any) -> Any:
    """Colours (N, 3) uint16 of a record."""
    return np.column_stack([part.red, part.green, part.blue])


def _colour_shift(path: Path) -> int | None:
    """Bits to shift colours right by to get 8-bit ones, None without colours; mostly the first points suffice."""
    with open_las(path) as reader:
        if "red" not in set(reader.header.point_format.dimension_names):
            return None
        filled = False
        for part in read_parts(path, reader, PROBE_POINTS):
            largest = _colours(part).max()
            if largest > 255:
                return 8
            filled |= bool(largest)
    return 0 if filled else None


def _to_uint8(rgb: Any) -> Any:
    if rgb is None or not rgb.any():  # colour fields that were never filled
        return None
    return (rgb >> 8).astype(np.uint8) if rgb.max() > 255 else rgb.astype(np.uint8)


def _crs(header: Any) -> tuple[str | None, tuple[str, ...]]:
    """CRS as WKT, or None; and a note if there is one that can't be read."""
    try:
        crs = las_header.parsed_crs(header)
    except ValueError as error:
        return None, (f"its CRS can't be read, so it counts as none ({error})",)
    return None if crs is None else crs.to_wkt(), ()
