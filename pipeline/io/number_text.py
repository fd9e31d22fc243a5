"""Numbers in text files, parsed block by block: memory is bounded whatever the file's size or line length."""

from __future__ import annotations

import codecs
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64

BLOCK_BYTES = 1 << 24
"""Bytes that are parsed at a time; also the maximum length of a line."""


def encoding_of(head: bytes) -> str:
    """Encoding of a text by its first bytes: UTF-16 (with or without a mark), UTF-8, else that of Western Windows."""
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return "utf-16"
    if len(head) > 3 and head[1::2].count(0) > 0.4 * len(head):
        return "utf-16-le"
    if len(head) > 3 and head[::2].count(0) > 0.4 * len(head):
        return "utf-16-be"
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head)  # a cut character at the end is no error
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8-sig"


def blocks(path: Path, file: BinaryIO, encoding: str = "utf-8-sig") -> Iterator[list[str]]:
    """The lines of an open file from its current position, block by block, without empty ones.

    Raises:
        InputError: it is not text, or has a line longer than `BLOCK_BYTES`.
    """
    rest, decoder = "", codecs.getincrementaldecoder(encoding)()
    while True:
        data = file.read(BLOCK_BYTES)
        try:
            text = rest + decoder.decode(data, final=not data)
        except UnicodeDecodeError as error:
            raise InputError(path, f"is not text ({error})", "Export it again, as UTF-8") from None
        head, newline, rest = text.rpartition("\n") if data else (text, "", "")
        if data and not newline and len(rest) >= BLOCK_BYTES:
            cause = f"has a line of more than {BLOCK_BYTES >> 20} MB"
            raise InputError(path, cause, "Export it again, one point per line")
        if lines := [line for line in head.splitlines() if line.strip()]:
            yield lines
        if not data:
            return


def numbers(lines: list[str], delimiter: str | None, width: int) -> F64:
    """Parse lines of `width` numbers each to (N, width); `delimiter` None: any white space.

    Raises:
        ValueError: a line contains something else, or a different number of values.
    """
    if not lines:
        return np.empty((0, width))
    values = np.loadtxt(lines, np.float64, delimiter=delimiter, comments=None, ndmin=2)
    if values.size and values.shape[1] != width:
        raise ValueError(f"a line has {values.shape[1]} numbers, not {width}")
    return values.reshape(-1, width)
