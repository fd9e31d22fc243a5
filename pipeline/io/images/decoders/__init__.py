"""Image decoders: one module per library (`pipeline.core.plugins`), for the formats that it reads best.

Comparison of the libraries: `bench/images.py`, docs/reference/formats.md.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy.typing as npt

Box = tuple[int, int, int, int]
"""Part of an image: first column and row, and column and row after the last (x0, y0, x1, y1)."""
COPY_AGAIN = "Copy it again, or leave it out"


class Header(NamedTuple):
    """Header of an image.

    Attributes:
        width, height: pixels.
        profile: ICC profile, or None.
    """

    width: int
    height: int
    profile: bytes | None


class Decoder(Protocol):
    """Interface of a decoder module. Its functions raise InputError if a file can't be read.

    Attributes:
        SUFFIXES: suffixes of its files, in lower case.
        PARTS: whether it can read a part of an image without decoding the rest.
    """

    SUFFIXES: tuple[str, ...]
    PARTS: bool

    def header(self, path: Path) -> Header:
        """Read the header only."""

    def check(self, path: Path) -> None:
        """Decode as much as necessary to know that the file is complete."""

    def pixels(self, path: Path, grey: bool = False, box: Box | None = None) -> npt.NDArray[Any]:
        """Pixels (H, W, 3) RGB, or (H, W) of a grey image, without applying the EXIF orientation.

        uint8 and uint16 are encoded as sRGB, or as the profile says; float32 is linear light with sRGB primaries.

        Args:
            path: image file.
            grey: grey levels are sufficient.
            box: part to read; None: the whole image.
        """
