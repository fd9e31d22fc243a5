"""EPT clouds (Entwine Point Tiles 1.1) in a local folder: `ept.json`, `ept-hierarchy/`, `ept-data/`.

Points with the withheld flag of LAS are left out: dimension `Withheld`, or its bit in `ClassFlags`.

The nodes of the octree are read one after another, coarse ones first. Supported data types: laszip, binary (the
schema's dimensions, packed) and zstandard (the same, compressed). A cloud is many files, so a tile can't use it
directly: `scan2sim import clouds` converts it to one LAZ file.

Source: https://entwine.io/en/latest/entwine-point-tile.html
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.optional_deps import require
from scan2sim.pipeline.core.types import F64, Bools
from scan2sim.pipeline.io import file_checks, point_chunks
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.point_chunks import READ_POINTS, Points

Schema = tuple[np.dtype[Any], dict[str, tuple[float, float]]]
"""Layout of a packed point, and scale and offset of each dimension."""
SUFFIXES = ("ept.json",)
REMEDY = "Copy the whole folder again, or rebuild it"
NODE_SUFFIXES = {"laszip": ".laz", "binary": ".bin", "zstandard": ".zst"}
DTYPE_KINDS = {"signed": "i", "unsigned": "u", "float": "f"}
MAX_JSON_BYTES = 100 << 20
"""Maximum size of a JSON file; Entwine splits its hierarchy into far smaller ones."""
WITHHELD_BIT = 4
"""Bit of the dimension ClassFlags (LAS 1.4 R15, table 16)."""
NODE_KEY = re.compile(r"\d{1,3}-\d{1,10}-\d{1,10}-\d{1,10}")
"""Depth, x, y, z."""


def read_header(path: Path) -> tuple[int, F64, F64, str | None, tuple[str, ...]]:
    """Number of points, low and high corner of the points (not of the octree), CRS as WKT or None, and notes."""
    found = point_chunks.summary(path, parts(path))
    return found.count, found.low, found.high, _crs(path, _json(path)), found.notes


def parts(path: Path) -> Iterator[Points]:
    """The points of all nodes, coarse nodes first, in chunks.

    Raises:
        InputError: a node is missing or damaged, or the data type is unknown.
        UnavailableError: zstandard isn't installed.
    """
    info = _json(path)
    kind = info.get("dataType")
    if kind not in NODE_SUFFIXES:
        raise InputError(
            path, f"has the unknown dataType {str(kind)[:40]!r}", f"Build it with {', '.join(NODE_SUFFIXES)}"
        )
    if kind == "zstandard":
        require(str(path), "zstandard")
    schema = None if kind == "laszip" else _schema(path, info)
    for key, count in _nodes(path.parent):
        tile = path.parent / "ept-data" / f"{key}{NODE_SUFFIXES[kind]}"
        if not tile.is_file():
            raise InputError(tile, f"file not found ({count:,} points of {path.parent.name})", REMEDY)
        done = 0
        for part in _laszip(tile) if schema is None else _packed(tile, schema, count):
            done += len(part)
            yield part
        if done != count:
            cause = f"is truncated or damaged: it has {done:,} points, the hierarchy says {count:,}"
            raise InputError(tile, cause, REMEDY)


def _nodes(folder: Path) -> Iterator[tuple[str, int]]:
    """Key (depth-x-y-z) and number of points of all nodes with points, one hierarchy file after another."""
    waiting, seen = ["0-0-0-0"], set[str]()
    while waiting:
        file = folder / "ept-hierarchy" / f"{waiting.pop(0)}.json"
        entries = _json(file)
        for key, count in entries.items():
            if not NODE_KEY.fullmatch(key) or not isinstance(count, int) or count < -1:
                raise InputError(file, f"its entry {key[:40]!r} is not an octree node", REMEDY)
        for key in sorted(entries, key=lambda key: [int(part) for part in key.split("-")]):
            count = entries[key]
            if count == -1:
                if key in seen:
                    raise InputError(file, f"refers to {key} a second time", REMEDY)
                seen.add(key)
                waiting.append(key)
            elif count > 0:
                yield key, count


def _laszip(tile: Path) -> Iterator[Points]:
    for part in las.records(tile, READ_POINTS):
        names = set(part.point_format.dimension_names)
        yield Points(
            np.column_stack([part.x, part.y, part.z]),
            np.column_stack([part.red, part.green, part.blue]) if "red" in names else None,
            classification=np.array(part.classification),
            time=np.array(part.gps_time) if "gps_time" in names else None,
            intensity=np.array(part.intensity),
            withheld=~las.in_use(part),
        )


def _packed(tile: Path, schema: Schema, count: int) -> Iterator[Points]:
    row, scales = schema
    if tile.suffix == ".bin" and tile.stat().st_size != count * row.itemsize:
        raise InputError(tile, f"has {tile.stat().st_size:,} bytes, expected {count * row.itemsize:,}", REMEDY)

    def column(rows: npt.NDArray[Any], name: str) -> Any:
        if name not in scales:
            return None
        scale, offset = scales[name]
        return rows[name] if (scale, offset) == (1, 0) else rows[name] * scale + offset

    for rows in _records(tile, row):
        rgb = [column(rows, name) for name in ("Red", "Green", "Blue")]
        yield Points(
            np.column_stack([np.asarray(column(rows, axis), np.float64) for axis in "XYZ"]),
            None if any(values is None for values in rgb) else np.column_stack(rgb),
            classification=column(rows, "Classification"),
            time=column(rows, "GpsTime"),
            intensity=column(rows, "Intensity"),
            withheld=_withheld(rows),
        )


def _withheld(rows: npt.NDArray[Any]) -> Bools | None:
    names = rows.dtype.names or ()
    if "Withheld" in names:
        return np.asarray(rows["Withheld"] != 0)
    return np.asarray(rows["ClassFlags"] & WITHHELD_BIT != 0) if "ClassFlags" in names else None


def _records(tile: Path, row: np.dtype[Any]) -> Iterator[npt.NDArray[Any]]:
    if tile.suffix == ".bin":
        with open(tile, "rb") as file:
            while data := file.read(READ_POINTS * row.itemsize):
                yield np.frombuffer(data, row)
        return
    import zstandard

    rest = b""
    try:
        with open(tile, "rb") as file, zstandard.ZstdDecompressor().stream_reader(file) as reader:
            while data := reader.read(READ_POINTS * row.itemsize):
                rest += data
                n = len(rest) // row.itemsize
                yield np.frombuffer(rest, row, n)
                rest = rest[n * row.itemsize :]
    except zstandard.ZstdError as error:
        raise InputError(tile, f"is not a readable zstd file ({error})", REMEDY) from None


def _schema(path: Path, info: dict[str, Any]) -> Schema:
    try:
        entries = [(str(entry["name"]), entry) for entry in info["schema"]]
        row = np.dtype([(name, f"<{DTYPE_KINDS[entry['type']]}{int(entry['size'])}") for name, entry in entries])
        scales = {name: (float(entry.get("scale", 1)), float(entry.get("offset", 0))) for name, entry in entries}
        good = {"X", "Y", "Z"} <= scales.keys() and np.isfinite(list(scales.values())).all()
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError):
        good = False
    if not good:
        raise InputError(path, "its schema has no valid dimensions X, Y and Z", REMEDY)
    return row, scales


def _json(path: Path) -> dict[str, Any]:
    file_checks.check(path, REMEDY)
    try:
        if path.stat().st_size > MAX_JSON_BYTES:
            raise ValueError(f"{path.stat().st_size:,} bytes")
        body = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(body, dict):
            raise ValueError("not an object")
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(path, f"is not readable JSON ({str(error)[:100]})", REMEDY) from None
    return body


def _crs(path: Path, info: dict[str, Any]) -> str | None:
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    srs = info.get("srs")
    if not isinstance(srs, dict) or not srs:
        return None
    text = srs.get("wkt") or f"{srs.get('authority')}:{srs.get('horizontal')}"
    try:
        return CRS.from_user_input(text).to_wkt()
    except CRSError as error:
        raise InputError(path, f"its CRS can't be read ({str(error)[:100]})", "Fix `srs` in ept.json") from None
