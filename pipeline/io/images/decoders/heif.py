"""HEIF decoder by pillow-heif: the photos of iPhones. Its pixels are upright: turns are a part of the format."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.io.images.decoders import Box, Header, opencv

NEEDS = ("pillow_heif",)
SUFFIXES = (".heic", ".heif")
PARTS = False


def register() -> None:
    """Make Pillow open HEIF files, if pillow-heif is installed."""
    try:
        import pillow_heif
    except ImportError:
        return
    pillow_heif.register_heif_opener()


def header(path: Path) -> Header:
    """See `pipeline.io.images.decoders.Decoder`."""
    register()
    return opencv.header(path)


def check(path: Path) -> None:
    """See `pipeline.io.images.decoders.Decoder`."""
    pixels(path)


def pixels(path: Path, grey: bool = False, box: Box | None = None) -> npt.NDArray[Any]:
    """See `pipeline.io.images.decoders.Decoder`."""
    register()
    with opencv.opened(path) as image:
        part = image if box is None else image.crop(box)
        return np.asarray(part.convert("L" if grey else "RGB"))
