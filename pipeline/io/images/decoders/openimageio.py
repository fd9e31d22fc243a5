"""OpenImageIO: EXR, which OpenCV's wheels don't read, Radiance HDR, and TIFF, of which it reads parts."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.io.images.decoders import AGAIN, Box, Header

NEEDS = ("OpenImageIO",)
SUFFIXES = (".tif", ".tiff", ".exr", ".hdr")
PARTS = True
LINEAR = "lin_rec709_scene"
MOST = 16
"""Channels; what has more is damaged, or no photo."""


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
        if spec.tile_width:  # whole tiles alone can be read
            left, right = _on_tiles(x0, x1, spec.tile_width, spec.width)
            top, low = _on_tiles(y0, y1, spec.tile_height, spec.height)
            found = source.read_tiles(0, 0, left, right, top, low, 0, 1, 0, channels, kind)
        else:
            found = source.read_scanlines(0, 0, y0, y1, 0, 0, channels, kind)
        if found is None:
            raise InputError(path, f"can't be read ({source.geterror()})", AGAIN)
        space = spec.get_string_attribute("oiio:ColorSpace")
    found = np.asarray(found).reshape(-1, found.shape[1], channels)[y0 - top : y1 - top, x0 - left : x1 - left]
    if kind == "float" and channels == 3:
        found = _linear(path, found, space)
    return np.ascontiguousarray(found[..., 0] if channels == 1 else found)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """A file, its header read.

    Raises:
        InputError: it can't be read, here or while it is open.
    """
    import OpenImageIO as oiio

    stored = oiio.ImageSpec()
    stored.attribute("oiio:UnassociatedAlpha", 1)  # colours aren't darkened by a fourth channel, often near infrared
    try:
        source = oiio.ImageInput.open(str(path), stored)
        if source is None:
            raise InputError(path, f"can't be read ({oiio.geterror()})", AGAIN)
        spec = source.spec()
        shown = spec.full_x, spec.full_y, spec.full_width, spec.full_height
        if (spec.x, spec.y, spec.width, spec.height) != shown or spec.depth != 1:
            raise InputError(path, "holds another window than it shows", "Export it whole, without crop or overscan")
        yield source
    except UnicodeDecodeError:  # of names and of what libraries cite, where they are damaged
        raise InputError(path, "can't be read (damaged texts)", AGAIN) from None


def _kind(spec: Any) -> str:
    """What to have pixels as."""
    if str(spec.format) in ("float", "half", "double"):
        return "float"
    return "uint8" if str(spec.format) == "uint8" else "uint16"


def _channels(path: Path, spec: Any) -> int:
    """How many of the first ones are the picture: 3 or 1.

    Raises:
        InputError: neither colours nor grey come first.
    """
    names = [name.upper() for name in spec.channelnames]
    if names[:3] == ["R", "G", "B"] and len(names) <= MOST:
        return 3
    if names[:1] in (["Y"], ["I"]) and len(names) <= 2:
        return 1
    told = ", ".join(spec.channelnames[:MOST])
    raise InputError(path, f"has the channels {told}", "Export the picture alone, as R, G, B")


def _on_tiles(first: int, end: int, tile: int, size: int) -> tuple[int, int]:
    """The range that the tiles with `first` to `end` cover."""
    return first // tile * tile, min(-(-end // tile) * tile, size)


def _linear(path: Path, light: npt.NDArray[Any], space: str) -> npt.NDArray[Any]:
    """Linear light of the file's colour space in the primaries of sRGB; of a file that tells none, as it is."""
    import OpenImageIO as oiio

    if space in ("", LINEAR):
        return light
    made = oiio.ImageBufAlgo.colorconvert(oiio.ImageBuf(np.ascontiguousarray(light)), space, LINEAR)
    if made.has_error:
        raise InputError(
            path, f"is in a colour space that isn't known ({made.geterror()})", "Export it in linear Rec. 709"
        )
    return np.asarray(made.get_pixels("float"))
