"""Writes classes back into LAS, LAZ and COPC files: a copy with new classes and everything else unchanged."""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.classes import CLASSES
from scan2sim.pipeline.core.errors import DataError, SpaceError, UnavailableError, from_os_error
from scan2sim.pipeline.core.types import U8
from scan2sim.pipeline.io import las_header
from scan2sim.pipeline.io.clouds.las import CHUNK_POINTS, open_las, read_parts
from scan2sim.pipeline.io.las_header import GEOTIFF_RECORDS, PROJECTION_USER, WKT_RECORD

EXTRA_DIMENSIONS = {"confidence": "255: sure", "class_source": "1 photos 2 shape 3 own"}
"""Extra-byte dimensions that are added (uint8 each): name and description, as written into the file."""
MODERN_FORMAT = {0: 6, 1: 6, 2: 7, 3: 7, 4: 9, 5: 10}
"""Legacy point format (5-bit classes) to the format with 8-bit classes and the same fields."""
LEGACY_FLAGS = (
    "return_number", "number_of_returns", "scan_direction_flag", "edge_of_flight_line", "synthetic", "key_point",
    "withheld",
)  # fmt: skip
LEGACY_OVERLAP_CLASS = 12
SCAN_ANGLE_STEP_DEG = 0.006

SPEC_USER = "LASF_Spec"  # user id of variable length records (VLR)
LOOKUP_RECORD, EXTRA_BYTES_RECORD, WAVEFORM_RECORD = 0, 4, 65535  # record ids of SPEC_USER


def write_classified(source: Path, out: Path, code: U8, confidence: U8, class_source: U8) -> None:
    """Copy a LAS, LAZ or COPC file with new classes and everything else unchanged.

    The copy is a LAZ file of LAS 1.4 (1.5 if the source is) with point format 6 or above, which codes over 31
    require: coordinates keep their integers, scales and offsets; scan angles in whole degrees are converted to units
    of 0.006 degrees; missing times become 0; points of the legacy class 12 (overlap) get the overlap flag instead.
    A CRS given as GeoTIFF keys becomes WKT, which these formats require (keys that can't be parsed stay). A
    classification lookup record names the classes. Not kept: a COPC file's octree (its points stay in file order), an
    earlier lookup record, and bytes between header, records and points to which LAS gives no meaning.

    Args:
        source: LAS, LAZ or COPC file of N points.
        out: LAZ file to write; an existing one is replaced once the new one is complete. May be `source`.
        code: (N,) LAS codes, in the order of the file's points.
        confidence: (N,) 0 to 255 (certain), stored as extra bytes; replaces a dimension of that name.
        class_source: (N,) source of the class (1 photos, 2 shape, 3 the file's own class), stored the same way.

    Raises:
        DataError: an array isn't as long as the file.
        InputError: the source is missing, unreadable or truncated.
        SpaceError: the disk is full or not writable.
        UnavailableError: waveforms of several scanner channels, which can't be written as LAZ.
    """
    from lazrs import LazrsError

    with open_las(source) as reader:
        n = reader.header.point_count
        for name, values in {"code": code, "confidence": confidence, "class_source": class_source}.items():
            if values.shape != (n,) or values.dtype != np.uint8:
                given = f"{name} is {values.dtype} of shape {values.shape}"
                raise DataError(source, f"has {n:,} points, but {given}", "Classify this file again: it has changed")
        temporary = out.with_name(f".{out.name}-{os.getpid()}")
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
            _copy(source, reader, temporary, code, (confidence, class_source))
            temporary.replace(out)
        except OSError as error:
            raise from_os_error(error, out) from error
        except LazrsError as error:  # hides the operating system's error; errors of reading are converted earlier
            raise SpaceError(out, f"can't be written ({error})", "Free some space and run again") from error
        finally:
            temporary.unlink(missing_ok=True)


def _copy(source: Path, reader: Any, out: Path, code: U8, extra_values: tuple[U8, U8]) -> None:
    from laspy import LasWriter, PackedPointRecord, PointFormat
    from laspy.vlrs.vlrlist import VLRList

    kept, structs = _extra_bytes(reader.header)
    header = _header(reader.header, structs)
    evlrs = VLRList(_records_to_keep(_extended_records(source, reader.header)))
    evlrs.sort(key=lambda record: not _is_waveforms(record))
    source_format = reader.header.point_format.id
    fields = set(PointFormat(source_format).dtype().names)
    common_fields = [name for name in PointFormat(header.point_format.id).dtype().names if name in fields]
    if source_format in MODERN_FORMAT:
        common_fields.remove("bit_fields")  # same name, different layout
    channel = None
    with out.open("wb") as file:
        writer = LasWriter(file, header, do_compress=True, closefd=False, encoding_errors="ignore")
        at = 0
        for part in read_parts(source, reader, CHUNK_POINTS):
            in_part = slice(at, at + len(part))
            at += len(part)
            points = PackedPointRecord.zeros(len(part), writer.header.point_format)
            for name in common_fields:
                points.array[name] = part.array[name]
            if source_format in MODERN_FORMAT:
                for name in LEGACY_FLAGS:
                    points[name] = np.array(part[name])
                points["overlap"] = np.array(part["classification"]) == LEGACY_OVERLAP_CLASS
                points.array["scan_angle"] = np.rint(part.array["scan_angle_rank"] / SCAN_ANGLE_STEP_DEG)
            if header.point_format.has_waveform_packet:
                channels = np.unique(np.array(points["scanner_channel"])).tolist()
                channel = channels[0] if channel is None else channel
                if channels != [channel]:
                    raise UnavailableError(
                        source,
                        "has waveforms of several scanner channels, which lazrs 0.8 corrupts in LAZ files",
                        "Split it by scanner channel first, or remove its waveforms (point format 6 or 8)",
                    )
            points.array["classification"] = code[in_part]
            old, new = part.array.view(np.uint8).reshape(len(part), -1), points.array["ExtraBytes"]
            to = 0
            for start, size in kept:
                new[:, to : to + size] = old[:, start : start + size]
                to += size
            new[:, to], new[:, to + 1] = (values[in_part] for values in extra_values)
            writer.write_points(points)
        writer.write_evlrs(evlrs)
        if evlrs and _is_waveforms(evlrs[0]):
            writer.header.start_of_waveform_data_packet_record = writer.header.start_of_first_evlr
        writer.close()


def _header(old: Any, structs: list[Any]) -> Any:
    """Header of the copy with its records; `structs` describe its extra bytes."""
    from laspy import VLR, LasHeader, PointFormat
    from laspy.header import GlobalEncoding
    from laspy.point.dims import DimensionInfo
    from laspy.vlrs.known import WktCoordinateSystemVlr

    point_format = PointFormat(MODERN_FORMAT.get(old.point_format.id, old.point_format.id))
    size = sum(s.dtype().itemsize for s in structs)  # a single field in memory, whatever the dimensions are called
    point_format.dimensions.append(DimensionInfo.from_dtype("ExtraBytes", np.dtype((np.uint8, size)), False))
    header = LasHeader(version="1.5" if old.version.minor >= 5 else "1.4", point_format=point_format)
    header.scales, header.offsets = old.scales, old.offsets
    header.file_source_id, header.uuid, header.creation_date = old.file_source_id, old.uuid, old.creation_date
    header.system_identifier, header.generating_software = old.system_identifier, old.generating_software
    if old.version.minor >= 5:
        header.gps_time_offset = old.gps_time_offset

    records = _records_to_keep(old.vlrs)
    has_wkt = any(_is_wkt(r) for r in _all_records(old))
    if not has_wkt and (wkt := _wkt_of_geotiff(old)):
        records.append(WktCoordinateSystemVlr(wkt))
        has_wkt = True
    if has_wkt:
        records = [r for r in records if r.user_id != PROJECTION_USER or r.record_id not in GEOTIFF_RECORDS]
    # laspy's own extra-bytes record would store minimum and maximum values, and computes them wrong
    header.vlrs.extract("ExtraBytesVlr")
    records.append(VLR(SPEC_USER, EXTRA_BYTES_RECORD, "Extra Bytes Record", b"".join(bytes(s) for s in structs)))
    records.append(VLR(SPEC_USER, LOOKUP_RECORD, "Classification Lookup", _lookup_record()))
    header.vlrs.extend(records)
    header.global_encoding = GlobalEncoding(old.global_encoding.value & (0x4F if old.version.minor >= 5 else 0xF))
    header.global_encoding.wkt = has_wkt
    return header


def _extra_bytes(header: Any) -> tuple[list[tuple[int, int]], list[Any]]:
    """Extra bytes to keep, as (start, size) within a point, and descriptions of all extra bytes of the copy."""
    from laspy import PointFormat
    from laspy.vlrs.known import ExtraBytesStruct, ExtraBytesVlr

    at, end = header.point_format.num_standard_bytes, header.point_format.size
    described = [s for r in _all_records(header) if isinstance(r, ExtraBytesVlr) for s in r.extra_bytes_structs]
    new_format = PointFormat(MODERN_FORMAT.get(header.point_format.id, header.point_format.id))
    used_names = (*new_format.dimension_names, *new_format.dtype().names, *EXTRA_DIMENSIONS)
    taken = {name.encode() for name in used_names}
    kept: list[tuple[int, int]] = []
    structs: list[Any] = []
    while at < end:
        size = described[0].dtype().itemsize if described else 0
        if described and at + size <= end:
            described_byte = ExtraBytesStruct.from_buffer_copy(described.pop(0))
        else:  # an undescribed byte; it needs a description, or readers can't locate the bytes after it
            described, size = [], 1
            described_byte = ExtraBytesStruct(b"ExtraBytes", 1)
            described_byte.options = 0
        if described_byte.name.decode() not in EXTRA_DIMENSIONS:
            stem, i = described_byte.name[:27], 1
            while described_byte.name in taken:
                described_byte.name, i = stem + b"_%d" % i, i + 1
            taken.add(described_byte.name)
            kept.append((at, size))
            structs.append(described_byte)
        at += size
    for name, description in EXTRA_DIMENSIONS.items():
        described_byte = ExtraBytesStruct(name.encode(), 1, description.encode())
        described_byte.options = 0  # no minimum and maximum value
        structs.append(described_byte)
    return kept, structs


def _lookup_record() -> bytes:
    names = {c.code: c.name.encode()[:15] for c in CLASSES}
    return b"".join(struct.pack("<B15s", code, names.get(code, b"")) for code in range(256))


def _all_records(header: Any) -> list[Any]:
    return [*header.vlrs, *(header.evlrs or [])]


def _extended_records(source: Path, header: Any) -> list[Any]:
    """Extended records (EVLR) after the points; the one that LAS 1.3 may have, waveforms, isn't read by laspy."""
    from laspy.vlrs.vlrlist import VLRList

    start = header.start_of_waveform_data_packet_record
    if header.version.minor != 3 or not start or not header.global_encoding.waveform_data_packets_internal:
        return list(header.evlrs or [])
    with source.open("rb") as file:
        file.seek(start)
        return list(VLRList.read_from(file, 1, extended=True))


def _records_to_keep(records: list[Any]) -> list[Any]:
    """Records that are still valid for the copy, as plain bytes."""
    from laspy import VLR

    kept = []
    for r in records:
        replaced = r.user_id == SPEC_USER and r.record_id in (LOOKUP_RECORD, EXTRA_BYTES_RECORD)
        blank = r.user_id == PROJECTION_USER and r.record_id == WKT_RECORD and not _is_wkt(r)
        if r.user_id in ("laszip encoded", "copc") or replaced or blank:
            continue
        description = r.description
        if isinstance(description, bytes):  # not ASCII
            description = description.decode("ascii", "ignore")
        kept.append(VLR(r.user_id, r.record_id, description, r.record_data_bytes()))
    return kept


def _is_wkt(record: Any) -> bool:
    is_crs = record.user_id == PROJECTION_USER and record.record_id == WKT_RECORD
    return is_crs and bool(record.record_data_bytes().strip(b"\0 "))


def _is_waveforms(record: Any) -> bool:
    return bool(record.user_id == SPEC_USER and record.record_id == WAVEFORM_RECORD)


def _wkt_of_geotiff(header: Any) -> str | None:
    """WKT of a CRS given as GeoTIFF keys, vertical CRS included; None if they name none, or one that can't be read."""
    from pyproj.exceptions import CRSError

    try:
        crs = las_header.parsed_crs(header)
    except ValueError:
        return None
    if crs is None:
        return None
    try:
        return str(crs.to_wkt("WKT1_GDAL"))  # LAS requires WKT 1
    except CRSError:
        return str(crs.to_wkt())
