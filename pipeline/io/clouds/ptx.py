"""PTX clouds (Leica Cyclone, FARO SCENE, Register 360): all scans of a text file, each transformed by its own matrix.

A scan is a header of ten lines (number of columns and of rows; position and axes of the scanner, which aren't read;
a 4 x 4 matrix for row vectors, with the translation in its last row), then a line `x y z intensity [r g b]` for each
beam. Beams without a return are at 0 0 0, and left out.

Source: https://paulbourke.net/dataformats/ptx/
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.io import file_checks, number_text, point_chunks
from scan2sim.pipeline.io.point_chunks import Points

SUFFIXES = (".ptx",)
HEADER_LINES = 10
WIDTHS = (4, 7)
"""Numbers of a line without and with colours."""
REMEDY = "Export it again, or as E57"


def read_header(path: Path) -> tuple[int, F64, F64, str | None, tuple[str, ...]]:
    """Number of points with a return, low and high corner, no CRS, and notes."""
    found = point_chunks.summary(path, parts(path))
    return found.count, found.low, found.high, None, found.notes


def parts(path: Path) -> Iterator[Points]:
    """The points of all scans, in chunks.

    Raises:
        InputError: the file is truncated, or isn't as described above.
    """
    header, left, scan, matrix = list[str](), 0, -1, np.eye(4)
    with file_checks.check(path).open("rb") as file:
        for lines in number_text.blocks(path, file):
            while lines:
                if left:
                    rows, lines = lines[:left], lines[left:]
                    left -= len(rows)
                    yield _points(path, rows, matrix, scan)
                    continue
                missing = HEADER_LINES - len(header)
                header, lines = header + lines[:missing], lines[missing:]
                if len(header) == HEADER_LINES:
                    left, matrix = _header(path, header, scan + 1)
                    header, scan = [], scan + 1
    if left or header or scan < 0:
        cause = f"is truncated: {left:,} lines of its last scan are missing" if left else "ends within a header"
        raise InputError(path, cause, "Copy or export it again")


def _header(path: Path, lines: list[str], scan: int) -> tuple[int, F64]:
    """Number of beams of a scan, and its matrix (4, 4) for row vectors."""
    try:
        columns, rows = int(lines[0]), int(lines[1])
        matrix = np.array([line.split() for line in lines[6:]], np.float64)
        if columns < 0 or rows < 0 or matrix.shape != (4, 4) or not np.isfinite(matrix).all():
            raise ValueError("its size or matrix is invalid")
        if np.abs(matrix[:, 3] - (0, 0, 0, 1)).max() > 1e-6:
            raise ValueError("the last column of its matrix isn't 0 0 0 1")
    except ValueError as error:
        raise InputError(path, f"is not a PTX cloud (header of scan {scan + 1}: {error})", REMEDY) from None
    return columns * rows, matrix


def _points(path: Path, rows: list[str], matrix: F64, scan: int) -> Points:
    width = len(rows[0].split())
    try:
        if width not in WIDTHS:
            raise ValueError(f"{width} numbers in the line {rows[0][:40]!r}")
        values = number_text.numbers(rows, None, width)
    except ValueError as error:
        raise InputError(path, f"is not a PTX cloud (scan {scan + 1}: {error})", REMEDY) from None
    xyz = values[:, :3]
    xyz[(xyz == 0).all(axis=1)] = np.nan
    rgb = values[:, 4:] if width == max(WIDTHS) else None
    return Points(xyz @ matrix[:3, :3] + matrix[3, :3], rgb, intensity=values[:, 3], scan=scan)
