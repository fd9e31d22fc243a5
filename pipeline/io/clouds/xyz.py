"""Clouds as text (.xyz, .csv, .txt, .asc): a point a line.

Commas, semicolons, tabs or blanks stand between the numbers. A heading names the columns, in any order (CloudCompare's
`//X Y Z R G B` is one); without a heading their number tells what they are:

| columns | taken as |
| --- | --- |
| 3 | x y z |
| 4 | x y z intensity |
| 5 | x y z intensity class |
| 6 | x y z r g b |
| 7 | x y z r g b intensity |
| 8 | x y z r g b intensity class |

What was assumed is told (`clouds.Header.notes`). Lines that begin with # or // are comments.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64, Frame, PointCloud
from scan2sim.pipeline.io import number_text, point_chunks
from scan2sim.pipeline.io.point_chunks import Points

SUFFIXES = (".xyz", ".csv", ".txt", ".asc")
COMMENTS = ("#", "//")
HEAD = 4_000
"""Bytes that the heading and the first line fit into."""
BY_COUNT: dict[int, tuple[str, ...]] = {
    3: ("x", "y", "z"),
    4: ("x", "y", "z", "intensity"),
    5: ("x", "y", "z", "intensity", "class"),
    6: ("x", "y", "z", "r", "g", "b"),
    7: ("x", "y", "z", "r", "g", "b", "intensity"),
    8: ("x", "y", "z", "r", "g", "b", "intensity", "class"),
}
NAMES = {
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
    columns: tuple[str, ...]  # "" for what isn't read
    delimiter: str | None
    heading: bool  # the first line that is no comment holds names
    note: str


def read_header(path: Path) -> tuple[int, F64, F64, str | None, tuple[str, ...]]:
    """Number of points, low and high corner, no CRS, and what was assumed of the columns."""
    found = point_chunks.summary(path, _parts(path))
    return found.count, found.low, found.high, None, (_form(path).note,)


def read(path: Path, frame: Frame) -> PointCloud:
    """All points in local coordinates, with what their columns hold."""
    return point_chunks.whole(path, _parts(path), frame)


def chunks(path: Path, frame: Frame, size: int) -> Iterator[PointCloud]:
    """The points in their order, `size` at a time at most."""
    return point_chunks.local(path, _parts(path), point_chunks.summary(path, _parts(path)), frame, size)


def _parts(path: Path) -> Iterator[Points]:
    form = _form(path)
    heading = form.heading
    with open(path, "rb") as file:
        for block in number_text.blocks(path, file):
            if heading:
                at = next((i for i, line in enumerate(block) if not _comment(line)), len(block))
                heading = at == len(block)  # comments alone: the heading is yet to come
                block = block[at + 1 :]
            rows = [line for line in block if not _comment(line)]
            if not rows:
                continue
            try:
                values = number_text.numbers(rows, form.delimiter, len(form.columns))
            except ValueError as error:
                cause = f"is no cloud of {len(form.columns)} columns a line ({error})"
                raise InputError(path, cause, "Export it again, a point a line") from None
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
    """What the first lines tell of delimiter and columns."""
    try:
        with open(path, "rb") as file:
            head = file.read(HEAD).decode("utf-8-sig", "replace")
    except FileNotFoundError:
        raise InputError(path, "is missing", "Put it there, or mend the name") from None
    except OSError as error:
        raise InputError(path, f"can't be read ({error.strerror})", "Name a file of points") from None
    lines = [line.strip() for line in head.splitlines() if line.strip()]
    named = next((line.lstrip("#/ ") for line in lines if _comment(line) and _is_heading(line.lstrip("#/ "))), None)
    rows = [line for line in lines if not _comment(line)]
    if not rows:
        raise InputError(path, "holds no points", "Leave it out, or export it again")
    heading = _is_heading(rows[0])
    named = rows[0] if heading else named
    first = rows[1] if heading and len(rows) > 1 else rows[0]
    delimiter = next((mark for mark in ";\t" if mark in first), "," if "," in first else None)
    cells = _cells(first, delimiter)
    if delimiter in (";", "\t", None) and any("," in cell for cell in cells):
        raise InputError(path, "writes decimals with a comma", "Export it with decimal points")
    try:
        [float(cell) for cell in cells]
    except ValueError:
        raise InputError(path, f"is no cloud: its first line is {first[:60]!r}", "Give x y z, ... a line") from None
    if named is not None:
        names = _cells(named, delimiter if delimiter and delimiter in named else None)
        columns = tuple(_known(name) for name in names)
        if len(columns) != len(cells):
            raise InputError(path, f"has {len(columns)} names of columns for {len(cells)} numbers", "Mend its heading")
        unread = [name for name, known in zip(names, columns, strict=True) if not known]
        note = f"columns by the heading: {_listed(columns)}" + (f"; not read: {', '.join(unread)}" if unread else "")
    elif len(cells) in BY_COUNT:
        columns = BY_COUNT[len(cells)]
        note = f"no heading: {len(cells)} columns taken as {' '.join(columns)}"
    else:
        raise InputError(path, f"has {len(cells)} columns and no heading", "Name them in its first line: x,y,z,r,g,b")
    twice = {name for name in columns if name and columns.count(name) > 1}
    if twice or not {"x", "y", "z"} <= set(columns):
        cause = f"names {sorted(twice)[0]} twice" if twice else "names no columns x, y and z"
        raise InputError(path, cause, "Mend its heading: x,y,z,r,g,b,intensity,class")
    return _Form(columns, delimiter, heading, note)


def _is_heading(line: str) -> bool:
    return {"x", "y", "z"} <= {_known(name) for name in re.split(r"[,;\s]+", line)}


def _known(name: str) -> str:
    plain = name.strip().strip('"').lower().replace(" ", "_")
    return next((known for known, others in NAMES.items() if plain in others), "")


def _cells(line: str, delimiter: str | None) -> list[str]:
    return [cell.strip() for cell in line.split(delimiter)]


def _listed(columns: tuple[str, ...]) -> str:
    return " ".join(name for name in columns if name)


def _comment(line: str) -> bool:
    return line.lstrip().startswith(COMMENTS)
