"""What a LAS header says, held against the file: laspy believes it, and would count to 2^63.

LAS 1.4 R15 (ASPRS) gives the offsets, LAZ's chunk table the number of compressed points.
"""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import Any, BinaryIO

from scan2sim.pipeline.core.errors import InputError

AGAIN = "Copy it again, or export it anew"
HEADERS = {0: 227, 1: 227, 2: 227, 3: 235, 4: 375, 5: 393}
"""Bytes of a header, by minor version."""
RECORDS = (20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67)
"""Bytes of a point, by format."""
VLR, EVLR = 54, 60
"""Bytes of the head of a record."""
COMPRESSED = 0xC0
"""Bits of the point format that LAZ sets."""
LAYERED, LAYERS = b"\3", {10: 9, 11: 1, 12: 2, 13: 1}
"""LAZ's compressor of point formats from 6 on, and how many layers its items have; extra bytes one each."""
VARIABLE = 0xFFFFFFFF
"""Points a chunk, where the chunk table says it for each, as in COPC files."""


def check(path: Path) -> tuple[str, ...]:
    """Refuse a header that the file doesn't bear out; returns what else is wrong with it.

    Raises:
        InputError: no LAS file, or truncated, or one whose counts and offsets lead out of it.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(HEADERS[5]).ljust(HEADERS[5], b"\0")
        if head[:4] != b"LASF" or size < HEADERS[0]:
            raise _bad(path, "it doesn't begin as one")
        minor, known = head[25], struct.unpack_from("<HIIBHI", head, 94)
        header_size, start, vlrs, kind, record, count = known
        if head[24] != 1 or minor not in HEADERS:
            raise _bad(path, f"of version {head[24]}.{minor}")
        if header_size < HEADERS[minor] or not header_size <= start <= size:
            raise _bad(path, f"{header_size:,} bytes of header, points from byte {start:,} on, {size:,} bytes in all")
        compressed, kind = bool(kind & COMPRESSED), kind & ~COMPRESSED
        if kind >= len(RECORDS) or record < RECORDS[kind]:
            raise _bad(path, f"points of format {kind} and {record} bytes")
        scales, offsets = struct.unpack_from("<3d", head, 131), struct.unpack_from("<3d", head, 155)
        if not all(map(math.isfinite, (*scales, *offsets))) or 0 in scales:
            raise _bad(path, f"coordinates are scaled by {scales} and moved by {offsets}")
        laszip = _walk(path, file, header_size, vlrs, VLR, start)
        end = size
        if minor >= 4:
            extended, number, count = struct.unpack_from("<QIQ", head, 235)
            if number:
                _walk(path, file, extended, number, EVLR, size)
                end = extended if extended >= start else size
        if minor == 3:
            end = struct.unpack_from("<Q", head, 227)[0] or size
        if compressed:
            return _compressed(path, file, start, size, count, laszip)
        there = (size - start) // record
        if there < count:
            raise truncated(path, there, count, "end of file")
        return _left_over(count, (end - start) // record)


def truncated(path: Path, at: int, count: int, cause: str) -> InputError:
    """Of points that are counted, but not there."""
    return InputError(path, f"is truncated or damaged: {at:,} of {count:,} points can be read ({cause})", AGAIN)


def _bad(path: Path, cause: str) -> InputError:
    return InputError(path, f"is no readable LAS file ({cause})", AGAIN)


def _left_over(count: int, there: int) -> tuple[str, ...]:
    more = f"its header counts {count:,} points, but there are {there:,} or more: the rest is left out"
    return (more,) if there > count else ()


def _walk(path: Path, file: BinaryIO, at: int, number: int, head: int, end: int) -> bytes:
    """Go through records that must end before byte `end`; returns what LAZ's own among them says, or nothing."""
    laszip = b""
    for i in range(number):
        file.seek(min(at, end))
        about = file.read(head)
        length = struct.unpack_from("<H" if head == VLR else "<Q", about, 20)[0] if len(about) == head else 0
        if len(about) < head or at + head + length > end:
            raise _bad(path, f"{number:,} records are named, but the {i + 1}. reaches beyond their end")
        if about[2:18].startswith(b"laszip encoded") and head == VLR:
            laszip = file.read(length)
        at += head + length
    return laszip


def _compressed(path: Path, file: BinaryIO, start: int, size: int, count: int, laszip: bytes) -> tuple[str, ...]:
    """Hold the number of points against LAZ's table of chunks, each of which begins with a whole point."""
    import lazrs

    chunk = struct.unpack_from("<I", laszip.ljust(16, b"\0"), 12)[0]
    if not chunk:
        raise _bad(path, "nothing in it tells how its points are compressed")
    file.seek(start)
    table = struct.unpack("<q", file.read(8).ljust(8, b"\xff"))[0]
    if table == -1:  # written to a stream: the last bytes tell
        file.seek(size - 8)
        table = struct.unpack("<q", file.read(8))[0]
    if not start + 8 <= table <= size - 8:
        raise truncated(path, 0, count, "its table of chunks lies beyond its end")
    file.seek(table)
    chunks = struct.unpack("<II", file.read(8))[1]
    if chunks * RECORDS[0] > table - start:
        raise truncated(path, 0, count, f"{chunks:,} chunks in {table - start:,} bytes")
    file.seek(start)
    try:
        lengths = lazrs.read_chunk_table(file, lazrs.LazVlr(laszip))
    except Exception as error:  # lazrs has its own kinds
        raise truncated(path, 0, count, f"its table of chunks: {error}") from None
    if sum(length for _, length in lengths) > table - start:
        raise truncated(path, 0, count, "its chunks reach beyond their table")
    _check_layers(path, file, start + 8, [length for _, length in lengths], laszip, count)
    if chunk == VARIABLE:
        there = sum(points for points, _ in lengths)
        if there < count:
            raise truncated(path, there, count, "end of chunks")
        return ()
    if count > chunks * chunk:
        raise truncated(path, chunks * chunk, count, "end of chunks")
    return _left_over(count, (chunks - 1) * chunk + 1) if chunks else ()


def _check_layers(path: Path, file: BinaryIO, at: int, lengths: list[int], laszip: bytes, count: int) -> None:
    """Hold the lengths of the layers that a chunk of point formats from 6 on is made of against the chunk's own.

    A chunk begins with a whole point and the number of its points; then come its layers' lengths, 32 bits each.
    """
    items = [struct.unpack_from("<HH", laszip, 34 + 6 * i) for i in range((len(laszip) - 34) // 6)]
    if laszip[:1] != LAYERED or not items:
        return
    layers = sum(LAYERS.get(kind, size) for kind, size in items)
    first = sum(size for _, size in items) + 4
    for length in lengths:
        file.seek(at + first)
        said = file.read(4 * layers)
        if len(said) < 4 * layers or sum(struct.unpack(f"<{layers}I", said)) > length:
            raise truncated(path, 0, count, f"the chunk at byte {at:,} is longer than its {length:,} bytes")
        at += length


def parsed_crs(header: Any) -> Any:
    """The CRS (of pyproj) that a header of laspy's names; None where it names none.

    Raises:
        ValueError: it can't be read.
    """
    from pyproj.exceptions import CRSError

    try:
        return header.parse_crs()
    except (CRSError, NotImplementedError) as error:  # the latter is laspy's, of keys that it can't read
        raise ValueError(str(error)) from error
