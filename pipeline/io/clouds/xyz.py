"""Text clouds (.xyz, .csv, .txt, .asc, .pts): one point per line.

Numbers are separated by commas, semicolons, tabs or spaces, with decimal points or commas, in UTF-8, UTF-16 or
Windows' encoding. A header line names the columns, in any order and several languages (CloudCompare's `//X Y Z R G B`
is one). Lines that start with # or // are comments; lines of one number (Leica's PTS) count the points that follow.
Without a header line, columns are assigned by their number and values (`pipeline.io.text_columns`). The
interpretation is reported to the user (`clouds.Header.notes`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.io import file_checks, number_text, point_chunks, tables, text_columns
from scan2sim.pipeline.io.point_chunks import Points

SUFFIXES = (".xyz", ".csv", ".txt", ".asc", ".pts")
COMMENTS = ("#", "//")
HEAD_BYTES = 1 << 18
"""Bytes that are read to detect encoding, delimiter and columns."""


@dataclass(frozen=True)
class _Form:
    columns: tuple[str, ...]  # "" for columns that aren't read
    delimiter: str | None
    has_header_line: bool  # whether the first line that is not a comment is the header line
    encoding: str
    decimal_commas: bool
    notes: tuple[str, ...]


def read_header(path: Path) -> tuple[int, F64, F64, str | None, tuple[str, ...]]:
    """Number of points, low and high corner, no CRS, and how the columns were interpreted."""
    found = point_chunks.summary(path, parts(path))
    return found.count, found.low, found.high, None, (*_form(path).notes, *found.notes)


def parts(path: Path) -> Iterator[Points]:
    """The points, in chunks.

    Raises:
        InputError: a line doesn't have the columns of the first ones.
    """
    form = _form(path)
    has_header_line = form.has_header_line
    with open(path, "rb") as file:
        for block in number_text.blocks(path, file, form.encoding):
            rows = [line for line in block if not _skipped(line)]
            if has_header_line and rows:
                has_header_line, rows = False, rows[1:]
            if not rows:
                continue
            try:
                values = _numbers(rows, form.delimiter, form.decimal_commas, len(form.columns))
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


def _numbers(rows: list[str], delimiter: str | None, decimal_commas: bool, width: int) -> F64:
    if decimal_commas:
        rows = [row.replace(",", ".") for row in rows]
    if delimiter:
        rows = [row.rstrip().rstrip(delimiter) for row in rows]
    return number_text.numbers(rows, delimiter, width)


def _form(path: Path) -> _Form:
    """Detect encoding, delimiter and columns from the first lines."""
    try:
        with open(path, "rb") as file:
            data = file.read(HEAD_BYTES)
    except FileNotFoundError:
        raise InputError(path, file_checks.NOT_FOUND, file_checks.CHECK_PATH) from None
    except OSError as error:
        raise InputError(path, f"can't be read ({error.strerror})", "Give a file of points") from None
    encoding = number_text.encoding_of(data)
    text = data.decode(encoding, "replace")
    if len(data) == HEAD_BYTES:
        text = text.rpartition("\n")[0] or text
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    rows = [line for line in lines if not _skipped(line)]
    if not rows:
        raise InputError(path, "contains no points", "Leave it out, or export it again")
    has_header_line = text_columns.is_heading(rows[0])
    heading = rows[0] if has_header_line else None
    rows = rows[1:] if has_header_line and len(rows) > 1 else rows
    delimiter, decimal_commas = tables.separators(rows[0])
    cells = _cells(rows[0], delimiter)
    try:
        [float(cell.replace(",", ".") if decimal_commas else cell) for cell in cells]
    except ValueError:
        cause = f"is not a cloud: its first line is {rows[0][:60]!r}"
        raise InputError(path, cause, "Write x y z and further numbers on each line") from None
    if heading is None:
        comments = [line.lstrip("#/ ") for line in lines if line.startswith(COMMENTS)]
        headings = [line for line in comments if text_columns.is_heading(line)]
        heading = next((line for line in headings if len(_names(line, delimiter)) == len(cells)), None)
    if heading is not None:
        columns, note = _named(path, heading, delimiter, len(cells))
    else:
        try:
            sample = _numbers(rows, delimiter, decimal_commas, len(cells))
        except ValueError:  # reading the points names the line
            sample = _numbers(rows[:1], delimiter, decimal_commas, len(cells))
        columns, note = text_columns.by_values(path, sample)
    habits = [
        *([f"text in {encoding.upper()}"] if encoding not in ("utf-8-sig",) else []),
        *(["decimal commas"] if decimal_commas else []),
    ]
    return _Form(columns, delimiter, has_header_line, encoding, decimal_commas, (note, *habits))


def _named(path: Path, heading: str, delimiter: str | None, width: int) -> tuple[tuple[str, ...], str]:
    """Columns by the header line, and the note on them."""
    names = _names(heading, delimiter)
    columns = tuple(text_columns.meaning(name) for name in names)
    if len(columns) != width:
        raise InputError(path, f"has {len(columns)} column names for {width} numbers", "Fix its header line")
    duplicates = {name for name in columns if name and columns.count(name) > 1}
    if duplicates or not {"x", "y", "z"} <= set(columns):
        cause = f"has two columns {sorted(duplicates)[0]}" if duplicates else "has no columns x, y and z"
        raise InputError(path, cause, "Fix its header line: x,y,z,r,g,b,intensity,class")
    unread = [name for name, known in zip(names, columns, strict=True) if not known]
    note = f"columns by the header line: {' '.join(name for name in columns if name)}"
    return columns, note + (f"; not read: {', '.join(unread)}" if unread else "")


def _names(heading: str, delimiter: str | None) -> list[str]:
    mark = next((mark for mark in (delimiter, ";", "\t", ",") if mark and mark in heading), None)
    return _cells(heading, mark)


def _cells(line: str, delimiter: str | None) -> list[str]:
    return [cell.strip() for cell in line.strip().rstrip(delimiter).split(delimiter)]


def _skipped(line: str) -> bool:
    """Whether a line is a comment, or the number of points that follow (PTS)."""
    text = line.strip()
    return text.startswith(COMMENTS) or text.isdecimal()
