"""Decoders of photos: a file a library (`pipeline.core.plugins`), of the formats that it reads better than the others.

Which is better, and by how much: `bench/images.py`, docs/formats.md.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy.typing as npt

Box = tuple[int, int, int, int]
"""The first column and row of a part, and those after its last."""
AGAIN = "Copy it again, or leave it out"


class Header(NamedTuple):
    """What a photo says of itself.

    Attributes:
        width, height: pixels.
        profile: ICC, of its colours; None: it has none.
    """

    width: int
    height: int
    profile: bytes | None


class Decoder(Protocol):
    """What a library's module has. All raise InputError where a file can't be read.

    Attributes:
        SUFFIXES: ends of its files' names, in small letters.
        PARTS: whether a part is read without the rest.
    """

    SUFFIXES: tuple[str, ...]
    PARTS: bool

    def header(self, path: Path) -> Header:
        """Read without the pixels."""

    def check(self, path: Path) -> None:
        """Decode as much as it takes to know that the file is whole."""

    def pixels(self, path: Path, grey: bool = False, box: Box | None = None) -> npt.NDArray[Any]:
        """(H, W, 3) RGB, or (H, W) where that is all there is, turned as they lie in the file.

        uint8 and uint16: encoded, as sRGB or as the profile says; float32: linear light in the primaries of sRGB.

        Args:
            grey: grey levels will do.
            box: part to be read; None: the whole.
        """
