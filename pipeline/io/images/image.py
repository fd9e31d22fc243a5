"""Photos and pictures as 8-bit sRGB, pixels as they lie in the file (docs/formats.md, "Photos").

The camera's orientation flag is ignored: poses and sizes are of the pixels. `pipeline.io.images.decoders` decodes.
"""

from __future__ import annotations

import errno
import os
from contextlib import suppress
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.optional_deps import need
from scan2sim.pipeline.core.types import U8, View
from scan2sim.pipeline.io import file_checks
from scan2sim.pipeline.io.images import colour, decoders
from scan2sim.pipeline.io.images.decoders import Box, Decoder, Header

MAX_PIXELS = 2**29
"""That are decoded at once: 32,768 x 16,384. What says it has more is taken for a decompression bomb."""
DECODERS = plugins.by_suffix(decoders.__name__)
SUFFIXES = tuple(DECODERS)
"""Ends of photos' names. OpenCV tries what is called otherwise."""


def size_of(path: Path, *, parts: bool = False) -> tuple[int, int]:
    """Width and height of a photo, pixels, as its header says.

    Args:
        parts: only parts of it will be read; where its format allows that, it may be of any size.

    Raises:
        InputError: it is missing, no file, no image, or larger than `MAX_PIXELS`.
        UnavailableError: what decodes it isn't installed.
    """
    decoder = _decoder(path)
    width, height, _ = decoder.header(path)
    if not (parts and decoder.PARTS):
        _check_size(path, width, height)
    return width, height


def check_decodes(path: Path) -> None:
    """Look through a photo.

    Raises:
        InputError, UnavailableError: it can't be decoded, as `size_of`.
    """
    _decoder(path).check(path)


def read_rgb(path: Path, box: Box | None = None) -> U8:
    """(H, W, 3) RGB of a photo, or of the part of it in a box.

    Raises:
        InputError, UnavailableError: it can't be read, as `size_of`.
    """
    decoder, found = _opened(path, box)
    levels = colour.to_8_bit(decoder.pixels(path, box=box))
    rgb = levels if levels.ndim == 3 else np.repeat(levels[..., None], 3, axis=2)
    if found.profile is None:
        return rgb
    try:
        return colour.to_srgb(rgb, found.profile)
    except ValueError as error:
        raise InputError(path, f"has a colour profile that can't be read ({error})", "Save it as sRGB") from None


def read_levels(path: Path) -> U8:
    """(H, W) grey levels of a photo.

    Raises:
        InputError, UnavailableError: it can't be read, as `size_of`.
    """
    import cv2

    decoder, _ = _opened(path, None)
    levels = colour.to_8_bit(decoder.pixels(path, grey=True))
    return levels if levels.ndim == 2 else np.asarray(cv2.cvtColor(levels, cv2.COLOR_RGB2GRAY))


def read_photo(view: View) -> U8:
    """(H, W, 3) RGB of a view's photo.

    Raises:
        InputError: it can't be read, or isn't of its camera's size.
    """
    return _of_size(view, view.photo, read_rgb(view.photo))


def usable_photo(view: View) -> U8 | None:
    """`read_photo`; None of what can't be used, which `views` and the steps that paint tell."""
    with suppress(InputError):
        return read_photo(view)
    return None


def usable_levels(view: View) -> U8 | None:
    """(H, W) grey levels of a view's photo; None likewise."""
    with suppress(InputError):
        return _of_size(view, view.photo, read_levels(view.photo))
    return None


def read_mask(view: View) -> U8 | None:
    """The view's mask (H, W), 0 where its photo must not be used; None if it has none.

    Raises:
        InputError: it can't be read, or isn't of its camera's size.
    """
    return None if view.mask is None else _of_size(view, view.mask, read_levels(view.mask))


def write(path: Path, image: U8, *, quality: int = 90, compression: int = 2) -> None:
    """Write (H, W, 3) RGB or (H, W) grey; `quality` is a JPEG's, `compression` a PNG's.

    Raises:
        OSError: nothing could be written; OpenCV doesn't say why, nearly always the disk is full.
    """
    import cv2

    pixels = image[..., ::-1] if image.ndim == 3 else image
    jpeg = path.suffix.lower() in (".jpg", ".jpeg")
    options = [cv2.IMWRITE_JPEG_QUALITY, quality] if jpeg else [cv2.IMWRITE_PNG_COMPRESSION, compression]
    if not cv2.imwrite(str(path), np.ascontiguousarray(pixels), options):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))


def _decoder(path: Path) -> Decoder:
    file_checks.check(path)
    decoder: Decoder = plugins.module(decoders.__name__, DECODERS.get(path.suffix.lower(), "opencv"))
    need(str(path), *plugins.needs(decoder))
    return decoder


def _opened(path: Path, box: Box | None) -> tuple[Decoder, Header]:
    decoder = _decoder(path)
    found = decoder.header(path)
    if box is not None and decoder.PARTS:
        _check_size(path, box[2] - box[0], box[3] - box[1])
    else:
        _check_size(path, found.width, found.height)
    return decoder, found


def _check_size(path: Path, width: int, height: int) -> None:
    if width * height > MAX_PIXELS:
        told = f"is of {width:,} x {height:,} pixels, more than {MAX_PIXELS:,}"
        raise InputError(path, told, "Give a smaller one")


def _of_size(view: View, path: Path, pixels: U8) -> U8:
    wanted, size = (view.camera.width, view.camera.height), pixels.shape[1::-1]
    if size != wanted:
        told = f"is {size[0]} x {size[1]} pixels, but its camera {wanted[0]} x {wanted[1]}"
        raise InputError(path, told, "Mend the camera's `size` (and focal, centre), or resize the photo")
    return pixels
