"""Tables in text files with a header line, as spreadsheets and other programs write them.

UTF-8, UTF-16 and Windows' cp1252; columns separated by commas, semicolons or tabs; numbers with decimal points or, in
tables that aren't separated by commas, decimal commas; column names in any case.
"""

from __future__ import annotations

import codecs
import csv
import unicodedata
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.io import file_checks

DELIMITERS = ",;\t"
REMEDY = "Export it as CSV in UTF-8, with a header line"
UTF16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        columns: names of its columns, lower case (or the known name that they stand for).
        rows: (line number in the file, cells by column); cells that are missing are empty.
        decimal_comma: whether its numbers have decimal commas.
    """

    path: Path
    columns: tuple[str, ...]
    rows: tuple[tuple[int, Mapping[str, str]], ...]
    decimal_comma: bool

    def require(self, names: Collection[str]) -> None:
        """Check that it has columns, and rows.

        Raises:
            InputError: it has not.
        """
        for name in names:
            if name not in self.columns:
                cause = f"has no column `{name}` (it has {', '.join(self.columns)})"
                raise InputError(self.path, cause, "Add it to the header line")
        if not self.rows:
            raise InputError(self.path, "has no rows", "Add them, or leave the file out")


def read(path: Path, aliases: Mapping[str, Sequence[str]] | None = None) -> Table:
    """Read a table.

    Args:
        path: text file with a header line.
        aliases: other names of columns (lower case) by the name that replaces them.

    Raises:
        InputError: it isn't a table.
    """
    text = read_text(path)
    lines = text.splitlines()
    first = next((line for line in lines if line.strip()), "")
    delimiter = max(DELIMITERS, key=first.count)
    names = {other: name for name, others in (aliases or {}).items() for other in others}
    try:
        reader = csv.reader(lines, delimiter=delimiter, skipinitialspace=True)
        cells = [(reader.line_num, [cell.strip() for cell in row]) for row in reader]
    except csv.Error as error:
        raise InputError(path, f"is not a table ({error})", REMEDY) from None
    filled = [(number, row) for number, row in cells if any(row)]
    if not filled:
        raise InputError(path, "is empty", REMEDY)
    header = [unicodedata.normalize("NFC", cell).strip(" #\"'").lower() for cell in filled[0][1]]
    columns = tuple(names.get(cell, cell) for cell in header)
    duplicate = next((name for name in columns if name and columns.count(name) > 1), None)
    if duplicate is not None:
        raise InputError(path, f"has two columns `{duplicate}`", "Rename one of them")
    rows = []
    for number, row in filled[1:]:
        if len(row) > len(columns) and any(row[len(columns) :]):
            cause = f"row {number}: {len(row)} cells, but {len(columns)} columns"
            raise InputError(
                path, cause, "Put text with commas in quotes; write decimal points, or separate by semicolons"
            )
        rows.append((number, dict(zip(columns, row + [""] * len(columns), strict=False))))
    decimal_comma = delimiter != "," and any(is_decimal_comma(cell) for _, row in rows for cell in row.values())
    return Table(path, tuple(name for name in columns if name), tuple(rows), decimal_comma)


def read_text(path: Path) -> str:
    """Text of a file: UTF-16 or UTF-8 by its first bytes and content, else cp1252.

    Raises:
        InputError: it isn't text.
    """
    data = file_checks.check(path).read_bytes()
    encoding = "utf-16" if data.startswith(UTF16) else "utf-8-sig"
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError:
        text = data.decode("cp1252", "replace")
    if "\0" in text:
        raise InputError(path, "is not a text file", REMEDY)
    return text


def is_decimal_comma(text: str) -> bool:
    """Whether a text is a number with a decimal comma: "-1,25"."""
    whole, comma, fraction = text.lstrip("+-").partition(",")
    mantissa = fraction.lower().partition("e")[0]
    return bool(comma) and (whole or "0").isdigit() and mantissa.isdigit() and "." not in text


def separators(row: str) -> tuple[str | None, bool]:
    """Delimiter of a row of numbers (None: white space), and whether numbers have decimal commas."""
    for mark in ";\t":
        if mark in row:
            return mark, any(is_decimal_comma(cell.strip()) for cell in row.split(mark))
    cells = row.split()
    if len(cells) >= 3 and "," in row and not any(cell.endswith(",") for cell in cells):
        return None, all(is_decimal_comma(cell) or "," not in cell for cell in cells)
    return ("," if "," in row else None), False
