"""Classes written back into LAS, LAZ and COPC files: a copy with new classes and everything else kept."""

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
from scan2sim.pipeline.io.clouds.las import CHUNK, _open, _parts

ADDED = {"confidence": "255: sure", "told_from": "1 photos 2 shape 3 own"}
"""Extra bytes that are added (uint8 each): name and description."""
MODERN = {0: 6, 1: 6, 2: 7, 3: 7, 4: 9, 5: 10}
"""Point formats of 5 bits of class, to those of 8 bits that hold the same."""
LEGACY_BITS = (
    "return_number", "number_of_returns", "scan_direction_flag", "edge_of_flight_line", "synthetic", "key_point",
    "withheld",
)  # fmt: skip
LEGACY_OVERLAP = 12
SCAN_ANGLE = 0.006  # degrees

SPEC, PROJECTION = "LASF_Spec", "LASF_Projection"
LOOKUP, EXTRA_BYTES, WAVEFORMS = 0, 4, 65535  # records of SPEC
WKT, GEOTIFF = 2112, (34735, 34736, 34737)  # records of PROJECTION
PROJECTED_KEY, VERTICAL_KEY = 3072, 4096  # GeoTIFF keys


def write_classified(source: Path, out: Path, code: U8, confidence: U8, told_from: U8) -> None:
    """Copy a LAS, LAZ or COPC file with new classes: everything else is kept.

    The copy is a LAZ file of LAS 1.4 (1.5 if the source is) with a point format of 6 or above, as codes over 31 need
    it: coordinates keep their integers, scales and offsets; scan angles of whole degrees become ones of 0.006 degrees;
    where the source has no times they are 0; points of the legacy class 12 (overlap) get the flag that took its place.
    A CRS of GeoTIFF keys becomes WKT, which these formats ask for (keys that can't be understood stay). The classes
    are named in a lookup record. Not kept: a COPC file's octree (its points stay in file order), a former lookup
    record, and bytes between header, records and points that LAS gives no meaning to.

    Args:
        source: LAS, LAZ or COPC file of N points.
        out: LAZ file to write; an earlier one is replaced once the new one is complete. May be `source`.
        code: (N,) LAS codes, in the order of the file's points.
        confidence: (N,) 0 to 255 (sure), kept as extra bytes in place of those of that name.
        told_from: (N,) what told the class (1 photos, 2 shape, 3 the file's own), kept likewise.

    Raises:
        DataError: an array isn't as long as the file.
        InputError: the source is missing, unreadable or truncated.
        SpaceError: the disk is full or may not be written to.
        UnavailableError: waveforms of several scanner channels, which can't be written as LAZ.
    """
    from lazrs import LazrsError

    with _open(source) as reader:
        n = reader.header.point_count
        for name, values in {"code": code, "confidence": confidence, "told_from": told_from}.items():
            if values.shape != (n,) or values.dtype != np.uint8:
                given = f"{name} is {values.dtype} of shape {values.shape}"
                raise DataError(source, f"has {n:,} points, but {given}", "Classify this very file, unchanged since")
        work = out.with_name(f".{out.name}-{os.getpid()}")
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
            _copy(source, reader, work, code, (confidence, told_from))
            work.replace(out)
        except OSError as error:
            raise from_os_error(error, out) from error
        except LazrsError as error:  # hides the system's own word; those of reading never come here
            raise SpaceError(out, f"can't be written ({error})", "Free some space and run again") from error
        finally:
            work.unlink(missing_ok=True)


def _copy(source: Path, reader: Any, out: Path, code: U8, added: tuple[U8, U8]) -> None:
    from laspy import LasWriter, PackedPointRecord, PointFormat
    from laspy.vlrs.vlrlist import VLRList

    kept, structs = _extra_bytes(reader.header)
    header = _header(reader.header, structs)
    evlrs = VLRList(_records(_extended(source, reader.header)))
    evlrs.sort(key=lambda record: not _is_waveforms(record))
    source_format = reader.header.point_format.id
    fields = set(PointFormat(source_format).dtype().names)
    same = [name for name in PointFormat(header.point_format.id).dtype().names if name in fields]
    if source_format in MODERN:
        same.remove("bit_fields")  # of the same name, not of the same layout
    channel = None
    with out.open("wb") as file:
        writer = LasWriter(file, header, do_compress=True, closefd=False, encoding_errors="ignore")
        at = 0
        for part in _parts(source, reader, CHUNK):
            here = slice(at, at + len(part))
            at += len(part)
            points = PackedPointRecord.zeros(len(part), writer.header.point_format)
            for name in same:
                points.array[name] = part.array[name]
            if source_format in MODERN:
                for name in LEGACY_BITS:
                    points[name] = np.array(part[name])
                points["overlap"] = np.array(part["classification"]) == LEGACY_OVERLAP
                points.array["scan_angle"] = np.rint(part.array["scan_angle_rank"] / SCAN_ANGLE)
            if header.point_format.has_waveform_packet:
                channels = np.unique(np.array(points["scanner_channel"])).tolist()
                channel = channels[0] if channel is None else channel
                if channels != [channel]:
                    raise UnavailableError(
                        source,
                        "has waveforms of several scanner channels, which lazrs 0.8 garbles in LAZ files",
                        "Split it by scanner channel first, or leave out its waveforms (point format 6 or 8)",
                    )
            points.array["classification"] = code[here]
            old, new = part.array.view(np.uint8).reshape(len(part), -1), points.array["ExtraBytes"]
            to = 0
            for start, size in kept:
                new[:, to : to + size] = old[:, start : start + size]
                to += size
            new[:, to], new[:, to + 1] = (values[here] for values in added)
            writer.write_points(points)
        writer.write_evlrs(evlrs)
        if evlrs and _is_waveforms(evlrs[0]):
            writer.header.start_of_waveform_data_packet_record = writer.header.start_of_first_evlr
        writer.close()


def _header(old: Any, structs: list[Any]) -> Any:
    """The copy's header, its records included; the record of the extra bytes is made of `structs`."""
    from laspy import VLR, LasHeader, PointFormat
    from laspy.header import GlobalEncoding
    from laspy.point.dims import DimensionInfo
    from laspy.vlrs.known import WktCoordinateSystemVlr

    point_format = PointFormat(MODERN.get(old.point_format.id, old.point_format.id))
    size = sum(s.dtype().itemsize for s in structs)  # one field in memory, whatever they are called
    point_format.dimensions.append(DimensionInfo.from_dtype("ExtraBytes", np.dtype((np.uint8, size)), False))
    header = LasHeader(version="1.5" if old.version.minor >= 5 else "1.4", point_format=point_format)
    header.scales, header.offsets = old.scales, old.offsets
    header.file_source_id, header.uuid, header.creation_date = old.file_source_id, old.uuid, old.creation_date
    header.system_identifier, header.generating_software = old.system_identifier, old.generating_software
    if old.version.minor >= 5:
        header.gps_time_offset = old.gps_time_offset

    records = _records(old.vlrs)
    has_wkt = any(_is_wkt(r) for r in _all(old))
    if not has_wkt and (wkt := _wkt_of_geotiff(old)):
        records.append(WktCoordinateSystemVlr(wkt))
        has_wkt = True
    if has_wkt:
        records = [r for r in records if r.user_id != PROJECTION or r.record_id not in GEOTIFF]
    # laspy's own record of extra bytes would keep least and greatest values, and counts them wrong
    header.vlrs.extract("ExtraBytesVlr")
    records.append(VLR(SPEC, EXTRA_BYTES, "Extra Bytes Record", b"".join(bytes(s) for s in structs)))
    records.append(VLR(SPEC, LOOKUP, "Classification Lookup", _lookup()))
    header.vlrs.extend(records)
    header.global_encoding = GlobalEncoding(old.global_encoding.value & (0x4F if old.version.minor >= 5 else 0xF))
    header.global_encoding.wkt = has_wkt
    return header


def _extra_bytes(header: Any) -> tuple[list[tuple[int, int]], list[Any]]:
    """Extra bytes that are kept, as (start, size) within a point; and descriptions of all that the copy has."""
    from laspy import PointFormat
    from laspy.vlrs.known import ExtraBytesStruct, ExtraBytesVlr

    at, end = header.point_format.num_standard_bytes, header.point_format.size
    described = [s for r in _all(header) if isinstance(r, ExtraBytesVlr) for s in r.extra_bytes_structs]
    new_format = PointFormat(MODERN.get(header.point_format.id, header.point_format.id))
    taken = {name.encode() for name in (*new_format.dimension_names, *new_format.dtype().names, *ADDED)}
    kept: list[tuple[int, int]] = []
    structs: list[Any] = []
    while at < end:
        size = described[0].dtype().itemsize if described else 0
        if described and at + size <= end:
            one = ExtraBytesStruct.from_buffer_copy(described.pop(0))
        else:  # undocumented, but what follows can only be found if it is described
            described, size = [], 1
            one = ExtraBytesStruct(b"ExtraBytes", 1)
            one.options = 0
        if one.name.decode() not in ADDED:
            stem, i = one.name[:27], 1
            while one.name in taken:
                one.name, i = stem + b"_%d" % i, i + 1
            taken.add(one.name)
            kept.append((at, size))
            structs.append(one)
        at += size
    for name, description in ADDED.items():
        one = ExtraBytesStruct(name.encode(), 1, description.encode())
        one.options = 0  # no least and greatest value
        structs.append(one)
    return kept, structs


def _lookup() -> bytes:
    names = {c.code: c.name.encode()[:15] for c in CLASSES}
    return b"".join(struct.pack("<B15s", code, names.get(code, b"")) for code in range(256))


def _all(header: Any) -> list[Any]:
    return [*header.vlrs, *(header.evlrs or [])]


def _extended(source: Path, header: Any) -> list[Any]:
    """Records behind the points; LAS 1.3 has one at most, which laspy doesn't read: waveforms."""
    from laspy.vlrs.vlrlist import VLRList

    start = header.start_of_waveform_data_packet_record
    if header.version.minor != 3 or not start or not header.global_encoding.waveform_data_packets_internal:
        return list(header.evlrs or [])
    with source.open("rb") as file:
        file.seek(start)
        return list(VLRList.read_from(file, 1, extended=True))


def _records(records: list[Any]) -> list[Any]:
    """Those that are still true of the copy, as plain bytes."""
    from laspy import VLR

    kept = []
    for r in records:
        replaced = r.user_id == SPEC and r.record_id in (LOOKUP, EXTRA_BYTES)
        blank = r.user_id == PROJECTION and r.record_id == WKT and not _is_wkt(r)
        if r.user_id in ("laszip encoded", "copc") or replaced or blank:
            continue
        described = r.description
        if isinstance(described, bytes):  # not ASCII
            described = described.decode("ascii", "ignore")
        kept.append(VLR(r.user_id, r.record_id, described, r.record_data_bytes()))
    return kept


def _is_wkt(record: Any) -> bool:
    is_crs = record.user_id == PROJECTION and record.record_id == WKT
    return is_crs and bool(record.record_data_bytes().strip(b"\0 "))


def _is_waveforms(record: Any) -> bool:
    return bool(record.user_id == SPEC and record.record_id == WAVEFORMS)


def _wkt_of_geotiff(header: Any) -> str | None:
    """The CRS of GeoTIFF keys, vertical one included; None if they don't say, or say it without EPSG's codes."""
    from pyproj import CRS
    from pyproj.crs import CompoundCRS
    from pyproj.exceptions import CRSError

    keys = {k.id: k.value_offset for r in header.vlrs.get("GeoKeyDirectoryVlr") for k in r.geo_keys}
    try:
        crs = las_header.parsed_crs(header)
    except ValueError:
        return None
    if crs is None or (PROJECTED_KEY in keys and not crs.is_projected):  # a projection of their own: not its datum's
        return None
    try:
        vertical = CRS.from_epsg(keys[VERTICAL_KEY])
        if vertical.is_vertical:
            crs = CompoundCRS(f"{crs.name} + {vertical.name}", [crs, vertical])
    except (KeyError, CRSError):  # none, or an ellipsoid's
        pass
    try:
        return str(crs.to_wkt("WKT1_GDAL"))  # what LAS asks for
    except CRSError:
        return str(crs.to_wkt())
