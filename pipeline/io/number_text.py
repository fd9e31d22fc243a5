"""Numbers in text files, block by block: no line, and no file, needs to fit into memory on its own word."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64

BLOCK = 1 << 24
"""Bytes that are parsed at a time, and that a line must not exceed."""


def blocks(path: Path, file: BinaryIO) -> Iterator[list[str]]:
    """The lines of an open file from where it stands, some at a time; empty ones are left out.

    Raises:
        InputError: it is no text, or has a line that never ends.
    """
    rest = b""
    while data := file.read(BLOCK):
        head, newline, tail = (rest + data).rpartition(b"\n")
        if not newline and len(tail) >= BLOCK:
            raise InputError(path, f"has a line of more than {BLOCK >> 20} MB", "Export it again, a point a line")
        rest = tail
        if lines := _lines(path, head):
            yield lines
    if lines := _lines(path, rest):
        yield lines


def _lines(path: Path, data: bytes) -> list[str]:
    try:
        lines = data.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise InputError(path, f"is no text ({error})", "Export it again, as UTF-8") from None
    return [line for line in lines if line.strip()]


def numbers(lines: list[str], delimiter: str | None, wide: int) -> F64:
    """(N, wide) of lines; `delimiter` None is any white space.

    Raises:
        ValueError: a line holds something else, or another number of them.
    """
    values = np.loadtxt(lines, np.float64, delimiter=delimiter, comments=None, ndmin=2)
    if values.size and values.shape[1] != wide:
        raise ValueError(f"a line has {values.shape[1]} numbers, not {wide}")
    return values.reshape(-1, wide)
