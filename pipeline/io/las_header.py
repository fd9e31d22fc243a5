"""Validation of LAS headers against the file: laspy trusts a header, even one that declares 2^63 points.

Offsets are those of LAS 1.4 R15 (ASPRS); the number of compressed points is checked against LAZ's chunk table.
"""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import Any, BinaryIO

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.io.geodata import geokeys

COPY_AGAIN = "Copy or export the file again"
HEADER_BYTES = {0: 227, 1: 227, 2: 227, 3: 235, 4: 375, 5: 393}
"""Size of the header, by minor version."""
POINT_BYTES = (20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67)
"""Minimum size of a point, by point format."""
VLR_HEADER_BYTES, EVLR_HEADER_BYTES = 54, 60
"""Size of the header of a variable length record, and of an extended one."""
COMPRESSED_BITS = 0xC0
"""Bits of the point format that LAZ sets."""
LAYERED_COMPRESSOR, ITEM_LAYERS = b"\3", {10: 9, 11: 1, 12: 2, 13: 1}
"""LAZ's compressor of point formats from 6 on, and the number of layers of each item type; extra bytes: one each."""
PROJECTION_USER, WKT_RECORD, GEOTIFF_RECORDS = "LASF_Projection", 2112, (34735, 34736, 34737)
"""User id of the records of a CRS, and their record ids."""
VARIABLE_CHUNKS = 0xFFFFFFFF
"""Chunk size that means: the chunk table lists the points of each chunk, as in COPC files."""


def check(path: Path) -> tuple[str, ...]:
    """Check a header against its file; returns warnings about tolerable errors.

    Raises:
        InputError: not a LAS file, truncated, or its counts and offsets point beyond the end of the file.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(HEADER_BYTES[5]).ljust(HEADER_BYTES[5], b"\0")
        if head[:4] != b"LASF" or size < HEADER_BYTES[0]:
            raise _unreadable(path, "it doesn't start with a LAS header")
        minor = head[25]
        header_size, start, vlrs, kind, record, count = struct.unpack_from("<HIIBHI", head, 94)
        if head[24] != 1 or minor not in HEADER_BYTES:
            raise _unreadable(path, f"unknown version {head[24]}.{minor}")
        if header_size < HEADER_BYTES[minor] or not header_size <= start <= size:
            raise _unreadable(
                path, f"its header is {header_size:,} bytes, its points start at byte {start:,}, the file has {size:,}"
            )
        compressed, kind = bool(kind & COMPRESSED_BITS), kind & ~COMPRESSED_BITS
        if kind >= len(POINT_BYTES) or record < POINT_BYTES[kind]:
            raise _unreadable(path, f"point format {kind} with {record} bytes per point")
        scales, offsets = struct.unpack_from("<3d", head, 131), struct.unpack_from("<3d", head, 155)
        if not all(map(math.isfinite, (*scales, *offsets))) or 0 in scales:
            raise _unreadable(path, f"its scales are {scales}, its offsets {offsets}")
        laszip = _check_records(path, file, header_size, vlrs, VLR_HEADER_BYTES, start)
        end = size
        if minor >= 4:
            extended, number, count = struct.unpack_from("<QIQ", head, 235)
            if number:
                _check_records(path, file, extended, number, EVLR_HEADER_BYTES, size)
                end = extended if extended >= start else size
        if minor == 3:
            end = struct.unpack_from("<Q", head, 227)[0] or size
        if compressed:
            return _check_chunk_table(path, file, start, size, count, laszip)
        available = (size - start) // record
        if available < count:
            raise truncated(path, available, count, "end of file")
        return _surplus_warning(count, (end - start) // record)


def truncated(path: Path, at: int, count: int, cause: str) -> InputError:
    """Error for a file that has fewer points than its header declares."""
    return InputError(path, f"is truncated or damaged: {at:,} of {count:,} points can be read ({cause})", COPY_AGAIN)


def _unreadable(path: Path, cause: str) -> InputError:
    return InputError(path, f"is not a readable LAS file ({cause})", COPY_AGAIN)


def _surplus_warning(count: int, available: int) -> tuple[str, ...]:
    warning = f"its header declares {count:,} points, but the file has {available:,} or more: the rest is ignored"
    return (warning,) if available > count else ()


def _check_records(path: Path, file: BinaryIO, at: int, number: int, header_bytes: int, end: int) -> bytes:
    """Check that variable length records end before byte `end`; returns the content of the laszip record, if any."""
    laszip = b""
    is_vlr = header_bytes == VLR_HEADER_BYTES
    for i in range(number):
        file.seek(min(at, end))
        head = file.read(header_bytes)
        length = struct.unpack_from("<H" if is_vlr else "<Q", head, 20)[0] if len(head) == header_bytes else 0
        if len(head) < header_bytes or at + header_bytes + length > end:
            raise _unreadable(path, f"record {i + 1:,} of {number:,} ends beyond the block of records")
        if head[2:18].startswith(b"laszip encoded") and is_vlr:
            laszip = file.read(length)
        at += header_bytes + length
    return laszip


def _check_chunk_table(path: Path, file: BinaryIO, start: int, size: int, count: int, laszip: bytes) -> tuple[str, ...]:
    """Check the number of points against LAZ's chunk table; each chunk starts with one uncompressed point."""
    import lazrs

    chunk = struct.unpack_from("<I", laszip.ljust(16, b"\0"), 12)[0]
    if laszip and not chunk:
        cause = "was compressed by LASzip 1, before 2011, whose points aren't in chunks"
        raise InputError(
            path, cause, "Write it again with a current LASzip, or as LAS: `las2las -i OLD.laz -o NEW.las`"
        )
    if not chunk:
        raise _unreadable(path, "it has no laszip record, which describes how points are compressed")
    file.seek(start)
    table = struct.unpack("<q", file.read(8).ljust(8, b"\xff"))[0]
    if table == -1:  # written to a stream: the table's position is in the last 8 bytes
        file.seek(size - 8)
        table = struct.unpack("<q", file.read(8))[0]
    if not start + 8 <= table <= size - 8:
        raise truncated(path, 0, count, "its chunk table is beyond the end of the file")
    file.seek(table)
    chunks = struct.unpack("<II", file.read(8))[1]
    if chunks * POINT_BYTES[0] > table - start:
        raise truncated(path, 0, count, f"{chunks:,} chunks in {table - start:,} bytes")
    file.seek(start)
    try:
        lengths = lazrs.read_chunk_table(file, lazrs.LazVlr(laszip))
    except Exception as error:  # lazrs raises exception types of its own
        raise truncated(path, 0, count, f"its chunk table: {error}") from None
    if sum(length for _, length in lengths) > table - start:
        raise truncated(path, 0, count, "its chunks extend beyond the chunk table")
    _check_layers(path, file, start + 8, [length for _, length in lengths], laszip, count)
    if chunk == VARIABLE_CHUNKS:
        available = sum(points for points, _ in lengths)
        if available < count:
            raise truncated(path, available, count, "end of chunks")
        return ()
    if count > chunks * chunk:
        raise truncated(path, chunks * chunk, count, "end of chunks")
    return _surplus_warning(count, (chunks - 1) * chunk + 1) if chunks else ()


def _check_layers(path: Path, file: BinaryIO, at: int, lengths: list[int], laszip: bytes, count: int) -> None:
    """Check the layer lengths of each chunk (point formats from 6 on) against the length of the chunk.

    A chunk starts with one uncompressed point and its number of points; then follow its layers' lengths, 32 bits each.
    """
    items = [struct.unpack_from("<HH", laszip, 34 + 6 * i) for i in range((len(laszip) - 34) // 6)]
    if laszip[:1] != LAYERED_COMPRESSOR or not items:
        return
    layers = sum(ITEM_LAYERS.get(kind, size) for kind, size in items)
    first = sum(size for _, size in items) + 4
    for length in lengths:
        file.seek(at + first)
        layer_lengths = file.read(4 * layers)
        if len(layer_lengths) < 4 * layers or sum(struct.unpack(f"<{layers}I", layer_lengths)) > length:
            raise truncated(path, 0, count, f"the layers of the chunk at byte {at:,} exceed its {length:,} bytes")
        at += length


def parsed_crs(header: Any) -> Any:
    """The CRS (pyproj) in a laspy header: of its WKT, else of its GeoTIFF keys with their units; None if it has none.

    Raises:
        ValueError: it can't be parsed.
    """
    records = {r.record_id: r for r in (*header.vlrs, *(header.evlrs or ())) if r.user_id == PROJECTION_USER}
    content = {key: record.record_data_bytes() for key, record in records.items()}
    problems = []
    for read, ids in ((_crs_of_wkt, (WKT_RECORD,)), (geokeys.crs_of_records, GEOTIFF_RECORDS)):
        if ids[0] in content:
            try:
                crs = read(*(content.get(key, b"") for key in ids))
            except ValueError as error:
                problems.append(str(error))
                continue
            if crs is not None:
                return crs
    if problems:
        raise ValueError("; ".join(problems))
    return None


def _crs_of_wkt(record: bytes) -> Any:
    """The CRS of a WKT record; None if it is empty, or a local one of its own."""
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    text = record.decode("utf-8", "replace").strip("\0 \t\r\n'\"")
    try:
        crs = CRS.from_user_input(text) if text else None
    except CRSError:
        raise ValueError(f"its WKT is no CRS: {text[:60]!r}") from None
    return None if crs is None or crs.is_engineering else crs
