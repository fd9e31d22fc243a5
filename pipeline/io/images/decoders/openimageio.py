"""OpenImageIO decoder: EXR (not supported by OpenCV's wheels), Radiance HDR, and TIFF, of which it can read parts."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.io.images.decoders import COPY_AGAIN, Box, Header

NEEDS = ("OpenImageIO",)
SUFFIXES = (".tif", ".tiff", ".exr", ".hdr")
PARTS = True
LINEAR_REC709 = "lin_rec709_scene"
MAX_CHANNELS = 16
"""A file with more channels is damaged, or not a photo."""


def header(path: Path) -> Header:
    """See `pipeline.io.images.decoders.Decoder`."""
    with _opened(path) as source:
        spec = source.spec()
        profile = spec.getattribute("ICCProfile")
        return Header(spec.width, spec.height, None if profile is None else np.asarray(profile, np.uint8).tobytes())


def check(path: Path) -> None:
    """See `pipeline.io.images.decoders.Decoder`."""
    pixels(path)


def pixels(path: Path, grey: bool = False, box: Box | None = None) -> npt.NDArray[Any]:
    """See `pipeline.io.images.decoders.Decoder`."""
    with _opened(path) as source:
        spec = source.spec()
        kind, channels = _kind(spec), _channels(path, spec)
        x0, y0, x1, y1 = box or (0, 0, spec.width, spec.height)
        left, top = 0, y0
        if spec.tile_width:  # only whole tiles can be read
            left, right = _tile_aligned(x0, x1, spec.tile_width, spec.width)
            top, low = _tile_aligned(y0, y1, spec.tile_height, spec.height)
            found = source.read_tiles(0, 0, left, right, top, low, 0, 1, 0, channels, kind)
        else:
            found = source.read_scanlines(0, 0, y0, y1, 0, 0, channels, kind)
        if found is None:
            raise InputError(path, f"can't be read ({source.geterror()})", COPY_AGAIN)
        space = spec.get_string_attribute("oiio:ColorSpace")
    found = np.asarray(found).reshape(-1, found.shape[1], channels)[y0 - top : y1 - top, x0 - left : x1 - left]
    if kind == "float" and channels == 3:
        found = _linear(path, found, space)
    return np.ascontiguousarray(found[..., 0] if channels == 1 else found)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open an image and read its header.

    Raises:
        InputError: it can't be read, now or inside the `with` block.
    """
    import OpenImageIO as oiio

    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)  # don't multiply colours by a fourth channel, often near infrared
    try:
        source = oiio.ImageInput.open(str(path), config)
        if source is None:
            raise InputError(path, f"can't be read ({oiio.geterror()})", COPY_AGAIN)
        spec = source.spec()
        display_window = spec.full_x, spec.full_y, spec.full_width, spec.full_height
        if (spec.x, spec.y, spec.width, spec.height) != display_window or spec.depth != 1:
            cause = "has a data window that differs from its display window"
            raise InputError(path, cause, "Export it without crop or overscan")
        yield source
    except UnicodeDecodeError:  # damaged names, or library errors that quote them
        raise InputError(path, "can't be read (damaged text in its header)", COPY_AGAIN) from None


def _kind(spec: Any) -> str:
    """Pixel type to read the image as."""
    if str(spec.format) in ("float", "half", "double"):
        return "float"
    return "uint8" if str(spec.format) == "uint8" else "uint16"


def _channels(path: Path, spec: Any) -> int:
    """Number of leading channels that are the image: 3 or 1.

    Raises:
        InputError: the first channels are neither RGB nor grey.
    """
    names = [name.upper() for name in spec.channelnames]
    if names[:3] == ["R", "G", "B"] and len(names) <= MAX_CHANNELS:
        return 3
    if names[:1] in (["Y"], ["I"]) and len(names) <= 2:
        return 1
    channels = ", ".join(spec.channelnames[:MAX_CHANNELS])
    raise InputError(path, f"has the unsupported channels {channels}", "Export it as R, G, B")


def _tile_aligned(first: int, end: int, tile: int, size: int) -> tuple[int, int]:
    """The range `first` to `end`, extended to whole tiles."""
    return first // tile * tile, min(-(-end // tile) * tile, size)


def _linear(path: Path, light: npt.NDArray[Any], space: str) -> npt.NDArray[Any]:
    """Convert linear light from the file's colour space to sRGB primaries; unchanged if it names no colour space."""
    import OpenImageIO as oiio

    if space in ("", LINEAR_REC709):
        return light
    converted = oiio.ImageBufAlgo.colorconvert(oiio.ImageBuf(np.ascontiguousarray(light)), space, LINEAR_REC709)
    if converted.has_error:
        cause = f"has an unknown colour space ({converted.geterror()})"
        raise InputError(path, cause, "Export it in linear Rec. 709")
    return np.asarray(converted.get_pixels("float"))
