"""PCD clouds (Point Cloud Library, file format 0.6 and 0.7): ascii, binary and binary_compressed.

A header of lines (VERSION, FIELDS, SIZE, TYPE, COUNT, WIDTH, HEIGHT, VIEWPOINT, POINTS, DATA), then the points.
`binary_compressed` data is two sizes (uint32) and LZF data, in which the values of each field are contiguous.
VIEWPOINT, the pose of the scanner, is not applied to the points; PCL's readers don't apply it either.

Other writers' habits: padding with COUNT 0 (no bytes), field names in capitals, `binary_compressed` data that LZF
couldn't compress and that is stored as it is, and zeros for beams without a return in organized clouds (HEIGHT over 1).

Source: https://pointclouds.org/documentation/tutorials/pcd_file_format.html; `rgb` is 0x00RRGGBB, in the bits of a
float32 or as uint32.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt
from numba import njit

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64, U8
from scan2sim.pipeline.io import file_checks, label_sets, number_text, point_chunks
from scan2sim.pipeline.io.point_chunks import READ_POINTS, Points

SUFFIXES = (".pcd",)
REMEDY = "Copy it again, or write it as binary PCD or LAZ"
DTYPE_KINDS = {"F": "f", "U": "u", "I": "i"}
MAX_LINE_BYTES = 10_000
"""Maximum length of a header line, and of a point."""
MAX_LZF_RATIO = 100
"""LZF compresses at most 264 bytes into 3: a file that declares a higher ratio than this is damaged."""
CLASSES = ("classification", "class", "label")
INTENSITIES = ("intensity", "intensities", "reflectivity")
TIMES = ("gps_time", "time", "timestamp")


@dataclass(frozen=True)
class _Header:
    row: np.dtype[Any]
    count: int
    data: str
    start: int  # byte offset of the points
    organized: bool  # rows of a scanner, in which beams without a return are zeros


def read_header(path: Path) -> tuple[int, F64, F64, str | None, tuple[str, ...]]:
    """Number of finite points, low and high corner, no CRS (PCD has none), and notes."""
    found = point_chunks.summary(path, parts(path))
    with open(path, "rb") as file:
        names = _header(file).row.names or ()
    field = next((name for name in CLASSES if name in names), None)
    return found.count, found.low, found.high, None, (*label_sets.field_notes(field), *found.notes)


def parts(path: Path) -> Iterator[Points]:
    """The points, in chunks; all at once if they are compressed.

    Raises:
        InputError: the file is missing, truncated or damaged.
    """
    for header, rows in _rows(path):
        yield _points(header, rows)


def _rows(path: Path) -> Iterator[tuple[_Header, npt.NDArray[Any]]]:
    """All points as structured arrays; fewer than declared is an error, and sizes are checked before allocation."""
    try:
        with open(path, "rb") as file:
            header = _header(file)
            left = path.stat().st_size - header.start
            if header.data == "ascii":
                for rows in _ascii(path, file, header):
                    yield header, rows
            elif header.data == "binary":
                if left < header.count * header.row.itemsize:
                    raise _truncated(path, left // header.row.itemsize, header.count)
                for at in range(0, header.count, READ_POINTS):
                    n = min(READ_POINTS, header.count - at)
                    yield header, np.frombuffer(file.read(n * header.row.itemsize), header.row, n)
            else:
                yield header, _compressed(path, file, header, left)
    except FileNotFoundError:
        raise InputError(path, file_checks.NOT_FOUND, file_checks.CHECK_PATH) from None
    except (OSError, ValueError) as error:
        raise InputError(path, f"is not a readable PCD cloud ({error})", REMEDY) from None


def _header(file: BinaryIO) -> _Header:
    entries: dict[str, list[str]] = {}
    while "DATA" not in entries:
        line = file.readline(MAX_LINE_BYTES)
        if not line.endswith(b"\n") or len(entries) > 20:
            raise ValueError("its header has no DATA line")
        key, *values = line.decode("ascii", "replace").partition("#")[0].split() or [""]
        if key:
            entries[key.upper()] = values
    try:
        names, kinds = [name.lower() for name in entries["FIELDS"]], entries["TYPE"]
        sizes = [int(value) for value in entries["SIZE"]]
        counts = [int(value) for value in entries.get("COUNT", ["1"] * len(names))]
        width, height = int(entries["WIDTH"][0]), int(entries["HEIGHT"][0])
        count = int(entries["POINTS"][0]) if "POINTS" in entries else width * height
        data = entries["DATA"][0].lower()
        shaped = [
            # PCL names all padding "_", but names in a dtype must be unique
            (f"_{i}" if name == "_" else name, f"<{DTYPE_KINDS[kind]}{size}", (n,) if n != 1 else ())
            for i, (name, kind, size, n) in enumerate(zip(names, kinds, sizes, counts, strict=True))
            if n != 0
        ]
        row = np.dtype(shaped)
    except (KeyError, IndexError, TypeError) as error:
        raise ValueError(f"its header has no valid {error}") from None
    if min(counts) < 0 or count < 1 or row.itemsize > MAX_LINE_BYTES:
        raise ValueError(f"its header declares {count} points of {row.itemsize} bytes")
    if data not in ("ascii", "binary", "binary_compressed"):
        raise ValueError(f"its DATA is the unknown {data[:40]!r}")
    if not {"x", "y", "z"} <= set(row.names or ()):
        raise ValueError(f"it has no x, y, z (its fields are {', '.join(names)})")
    return _Header(row, count, data, file.tell(), height > 1)


def _ascii(path: Path, file: BinaryIO, header: _Header) -> Iterator[npt.NDArray[Any]]:
    width = sum(int(np.prod(header.row[name].shape)) for name in header.row.names or ())
    done = 0
    for block in number_text.blocks(path, file):
        values = number_text.numbers(block, None, width)
        yield _records(values, header.row)
        done += len(values)
    if done < header.count:
        raise _truncated(path, done, header.count)
    if done > header.count:
        raise ValueError(f"it has {done:,} points, its header declares {header.count:,}")


def _records(values: F64, row: np.dtype[Any]) -> npt.NDArray[Any]:
    out = np.zeros(len(values), row)
    at = 0
    for name in row.names or ():
        n = int(np.prod(row[name].shape))
        column = values[:, at : at + n].reshape(len(values), *row[name].shape)
        packed = name in ("rgb", "rgba") and row[name].kind == "f" and bool((column > 1).any())
        # newer writers print packed colours as integers, older ones as floats with the same bits
        out[name] = column.astype(np.uint32).view(np.float32) if packed else column
        at += n
    return out


def _compressed(path: Path, file: BinaryIO, header: _Header, left: int) -> npt.NDArray[Any]:
    packed, size = (int(value) for value in np.frombuffer(file.read(8), "<u4", 2))
    if size != header.count * header.row.itemsize:
        raise ValueError(f"it unpacks to {size:,} bytes, its header declares {header.count * header.row.itemsize:,}")
    if packed > left - 8:
        raise InputError(path, f"is truncated: it has {left - 8:,} of {packed:,} bytes", REMEDY)
    if size > packed * MAX_LZF_RATIO:
        raise ValueError(f"it declares {packed:,} packed bytes that unpack to {size:,}, which LZF can't do")
    data, plain = np.frombuffer(file.read(packed), np.uint8), np.empty(size, np.uint8)
    if packed == size:  # stored as it is: LZF couldn't compress it
        plain = data
    elif _unpack(data, plain) != size:
        raise ValueError("its packed data is damaged")
    rows, at = np.empty(header.count, header.row), 0
    for name in header.row.names or ():
        kind = header.row[name]
        end = at + header.count * kind.itemsize
        rows[name] = plain[at:end].view(kind.base).reshape(header.count, *kind.shape)
        at = end
    return rows


@njit(cache=True)
def _unpack(packed: U8, plain: U8) -> int:
    """Decompress LZF (Lehmann's liblzf) into `plain`; returns the number of bytes, -1 if damaged.

    A control byte below 32 is the length of a literal run minus one, others are references to earlier output.
    """
    i, o, n, size = 0, 0, len(packed), len(plain)
    while i < n:
        control = packed[i]
        i += 1
        if control < 32:
            length = control + 1
            if i + length > n or o + length > size:
                return -1
            plain[o : o + length] = packed[i : i + length]
            i += length
        else:
            length = control >> 5
            if length == 7:
                if i >= n:
                    return -1
                length += packed[i]
                i += 1
            length += 2
            if i >= n:
                return -1
            back = o - ((control & 31) << 8) - packed[i] - 1
            i += 1
            if back < 0 or o + length > size:
                return -1
            for k in range(length):  # byte by byte: source and target may overlap
                plain[o + k] = plain[back + k]
        o += length
    return o


def _points(header: _Header, rows: npt.NDArray[Any]) -> Points:
    names = rows.dtype.names or ()

    def first(wanted: tuple[str, ...]) -> Any:
        return next((rows[name] for name in wanted if name in names and rows[name].ndim == 1), None)

    xyz = np.column_stack([np.asarray(rows[axis], np.float64) for axis in "xyz"])
    if header.organized:
        xyz[(xyz == 0).all(axis=1)] = np.nan
    rgb = first(("rgb", "rgba"))
    if rgb is not None and rgb.dtype.itemsize == 4:
        bits = np.ascontiguousarray(rgb).view(np.uint32)
        rgb = np.stack([bits >> 16 & 255, bits >> 8 & 255, bits & 255], axis=1).astype(np.uint8)
    elif {"r", "g", "b"} <= set(names):
        rgb = np.column_stack([rows[name] for name in "rgb"])
    else:
        rgb = None
    return Points(xyz, rgb, classification=first(CLASSES), time=first(TIMES), intensity=first(INTENSITIES))


def _truncated(path: Path, available: int, count: int) -> InputError:
    return InputError(path, f"is truncated or damaged: {available:,} of {count:,} points can be read", REMEDY)
