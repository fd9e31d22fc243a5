"""Text clouds (.xyz, .csv, .txt, .asc): one point per line.

Numbers are separated by commas, semicolons, tabs or spaces. A header line names the columns, in any order
(CloudCompare's `//X Y Z R G B` is one); without a header line, columns are assigned by their number:

| columns | interpreted as |
| --- | --- |
| 3 | x y z |
| 4 | x y z intensity |
| 5 | x y z intensity class |
| 6 | x y z r g b |
| 7 | x y z r g b intensity |
| 8 | x y z r g b intensity class |

The interpretation is reported to the user (`clouds.Header.notes`). Lines that start with # or // are comments.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64, Frame, PointCloud
from scan2sim.pipeline.io import file_checks, number_text, point_chunks
from scan2sim.pipeline.io.point_chunks import Points

SUFFIXES = (".xyz", ".csv", ".txt", ".asc")
COMMENTS = ("#", "//")
HEADER_BYTES = 4_000
"""Bytes that are read to detect columns and delimiter; header line and first point must fit into them."""
COLUMNS_BY_COUNT: dict[int, tuple[str, ...]] = {
    3: ("x", "y", "z"),
    4: ("x", "y", "z", "intensity"),
    5: ("x", "y", "z", "intensity", "class"),
    6: ("x", "y", "z", "r", "g", "b"),
    7: ("x", "y", "z", "r", "g", "b", "intensity"),
    8: ("x", "y", "z", "r", "g", "b", "intensity", "class"),
}
COLUMN_NAMES = {
    "x": ("x", "easting", "east", "e"),
    "y": ("y", "northing", "north", "n"),
    "z": ("z", "height", "elevation", "altitude"),
    "r": ("r", "red", "rf"),
    "g": ("g", "green", "gf"),
    "b": ("b", "blue", "bf"),
    "intensity": ("intensity", "i", "reflectance", "scalar_intensity"),
    "class": ("class", "classification", "label", "scalar_classification"),
    "time": ("time", "gps_time", "gpstime", "timestamp", "scalar_gpstime"),
}


@dataclass(frozen=True)
class _Form:
    columns: tuple[str, ...]  # "" for columns that aren't read
    delimiter: str | None
    has_header_line: bool  # whether the first line that is not a comment is the header line
    note: str


def read_header(path: Path) -> tuple[int, F64, F64, str | None, tuple[str, ...]]:
    """Number of points, low and high corner, no CRS, and how the columns were interpreted."""
    found = point_chunks.summary(path, _parts(path))
    return found.count, found.low, found.high, None, (_form(path).note, *found.notes)


def read(path: Path, frame: Frame) -> PointCloud:
    """All points in local coordinates, with the attributes of their columns."""
    return point_chunks.read_all(path, _parts(path), frame)


def chunks(path: Path, frame: Frame, size: int) -> Iterator[PointCloud]:
    """The points in file order, at most `size` per chunk."""
    return point_chunks.read_chunks(path, _parts(path), point_chunks.summary(path, _parts(path)), frame, size)


def _parts(path: Path) -> Iterator[Points]:
    form = _form(path)
    has_header_line = form.has_header_line
    with open(path, "rb") as file:
        for block in number_text.blocks(path, file):
            if has_header_line:
                at = next((i for i, line in enumerate(block) if not _comment(line)), len(block))
                has_header_line = at == len(block)  # only comments in this block: the header line is still to come
                block = block[at + 1 :]
            rows = [line for line in block if not _comment(line)]
            if not rows:
                continue
            try:
                values = number_text.numbers(rows, form.delimiter, len(form.columns))
            except ValueError as error:
                cause = f"is not a cloud with {len(form.columns)} columns per line ({error})"
                raise InputError(path, cause, "Export it again, one point per line") from None
            yield _points(values, form)


def _points(values: F64, form: _Form) -> Points:
    column = {name: values[:, i] for i, name in enumerate(form.columns) if name}
    return Points(
        np.column_stack([column[axis] for axis in "xyz"]),
        np.column_stack([column[c] for c in "rgb"]) if {"r", "g", "b"} <= set(column) else None,
        classification=column.get("class"),
        time=column.get("time"),
        intensity=column.get("intensity"),
    )


def _form(path: Path) -> _Form:
    """Detect delimiter and columns from the first lines."""
    try:
        with open(path, "rb") as file:
            head = file.read(HEADER_BYTES).decode("utf-8-sig", "replace")
    except FileNotFoundError:
        raise InputError(path, file_checks.NOT_FOUND, file_checks.CHECK_PATH) from None
    except OSError as error:
        raise InputError(path, f"can't be read ({error.strerror})", "Give a file of points") from None
    lines = [line.strip() for line in head.splitlines() if line.strip()]
    header_line = next(
        (line.lstrip("#/ ") for line in lines if _comment(line) and _is_header_line(line.lstrip("#/ "))), None
    )
    rows = [line for line in lines if not _comment(line)]
    if not rows:
        raise InputError(path, "contains no points", "Leave it out, or export it again")
    has_header_line = _is_header_line(rows[0])
    header_line = rows[0] if has_header_line else header_line
    first = rows[1] if has_header_line and len(rows) > 1 else rows[0]
    delimiter = next((mark for mark in ";\t" if mark in first), "," if "," in first else None)
    cells = _cells(first, delimiter)
    if delimiter in (";", "\t", None) and any("," in cell for cell in cells):
        raise InputError(path, "has numbers with decimal commas", "Export it with decimal points")
    try:
        [float(cell) for cell in cells]
    except ValueError:
        cause = f"is not a cloud: its first line is {first[:60]!r}"
        raise InputError(path, cause, "Write x y z and further numbers on each line") from None
    if header_line is not None:
        names = _cells(header_line, delimiter if delimiter and delimiter in header_line else None)
        columns = tuple(_column_of(name) for name in names)
        if len(columns) != len(cells):
            cause = f"has {len(columns)} column names for {len(cells)} numbers"
            raise InputError(path, cause, "Fix its header line")
        unread = [name for name, known in zip(names, columns, strict=True) if not known]
        note = f"columns by the header line: {_joined(columns)}" + (
            f"; not read: {', '.join(unread)}" if unread else ""
        )
    elif len(cells) in COLUMNS_BY_COUNT:
        columns = COLUMNS_BY_COUNT[len(cells)]
        note = f"no header line: {len(cells)} columns interpreted as {' '.join(columns)}"
    else:
        cause = f"has {len(cells)} columns and no header line"
        raise InputError(path, cause, "Name the columns in its first line: x,y,z,r,g,b")
    duplicates = {name for name in columns if name and columns.count(name) > 1}
    if duplicates or not {"x", "y", "z"} <= set(columns):
        cause = f"has two columns {sorted(duplicates)[0]}" if duplicates else "has no columns x, y and z"
        raise InputError(path, cause, "Fix its header line: x,y,z,r,g,b,intensity,class")
    return _Form(columns, delimiter, has_header_line, note)


def _is_header_line(line: str) -> bool:
    return {"x", "y", "z"} <= {_column_of(name) for name in re.split(r"[,;\s]+", line)}


def _column_of(name: str) -> str:
    plain = name.strip().strip('"').lower().replace(" ", "_")
    return next((known for known, others in COLUMN_NAMES.items() if plain in others), "")


def _cells(line: str, delimiter: str | None) -> list[str]:
    return [cell.strip() for cell in line.split(delimiter)]


def _joined(columns: tuple[str, ...]) -> str:
    return " ".join(name for name in columns if name)


def _comment(line: str) -> bool:
    return line.lstrip().startswith(COMMENTS)
