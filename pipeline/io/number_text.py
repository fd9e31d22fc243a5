"""Numbers in text files, parsed block by block: memory is bounded whatever the file's size or line length."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64

BLOCK_BYTES = 1 << 24
"""Bytes that are parsed at a time; also the maximum length of a line."""


def blocks(path: Path, file: BinaryIO) -> Iterator[list[str]]:
    """The lines of an open file from its current position, block by block, without empty ones.

    Raises:
        InputError: it is not text, or has a line longer than `BLOCK_BYTES`.
    """
    rest = b""
    while data := file.read(BLOCK_BYTES):
        head, newline, tail = (rest + data).rpartition(b"\n")
        if not newline and len(tail) >= BLOCK_BYTES:
            cause = f"has a line of more than {BLOCK_BYTES >> 20} MB"
            raise InputError(path, cause, "Export it again, one point per line")
        rest = tail
        if lines := _lines(path, head):
            yield lines
    if lines := _lines(path, rest):
        yield lines


def _lines(path: Path, data: bytes) -> list[str]:
    try:
        lines = data.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise InputError(path, f"is not text ({error})", "Export it again, as UTF-8") from None
    return [line for line in lines if line.strip()]


def numbers(lines: list[str], delimiter: str | None, width: int) -> F64:
    """Parse lines of `width` numbers each to (N, width); `delimiter` None: any white space.

    Raises:
        ValueError: a line contains something else, or a different number of values.
    """
    values = np.loadtxt(lines, np.float64, delimiter=delimiter, comments=None, ndmin=2)
    if values.size and values.shape[1] != width:
        raise ValueError(f"a line has {values.shape[1]} numbers, not {width}")
    return values.reshape(-1, width)
