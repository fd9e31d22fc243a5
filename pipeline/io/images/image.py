"""Reading of images as 8-bit sRGB, with pixels in file order (docs/reference/formats.md, "Photos").

EXIF's orientation flag is ignored: poses and sizes refer to the pixels as stored. The decoders are in
`pipeline.io.images.decoders`.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.optional_deps import require
from scan2sim.pipeline.core.types import U8, View
from scan2sim.pipeline.io import file_checks
from scan2sim.pipeline.io.images import colour, decoders
from scan2sim.pipeline.io.images.decoders import Box, Decoder, Header

MAX_PIXELS = 2**29
"""Maximum number of pixels decoded at once: 32,768 x 16,384. Larger images are rejected as decompression bombs."""
DECODERS = plugins.by_suffix(decoders.__name__)
SUFFIXES = tuple(DECODERS)
"""Suffixes of photos. Files with other suffixes are decoded by OpenCV."""


def size_of(path: Path, *, parts: bool = False) -> tuple[int, int]:
    """Width and height of a photo in pixels, from its header.

    Args:
        path: image file.
        parts: only parts of it will be read; it may be of any size if its format supports that.

    Raises:
        InputError: not found, not a file, not an image, or larger than `MAX_PIXELS`.
        UnavailableError: its decoder isn't installed.
    """
    decoder = _decoder(path)
    width, height, _ = decoder.header(path)
    if not (parts and decoder.PARTS):
        _check_size(path, width, height)
    return width, height


def check_decoders(paths: Iterable[Path]) -> None:
    """Check that the decoders of photos are installed.

    Raises:
        UnavailableError: one isn't; names a photo that needs it.
    """
    for path in {path.suffix.lower(): path for path in paths}.values():
        require(str(path), *plugins.needs(_module(path)))


def check_decodes(path: Path) -> None:
    """Check that a photo can be decoded completely.

    Raises:
        InputError, UnavailableError: it can't be decoded, as `size_of`.
    """
    _decoder(path).check(path)


def read_rgb(path: Path, box: Box | None = None) -> U8:
    """RGB (H, W, 3) of a photo, or of the part of it in a box.

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
    """Grey levels (H, W) of a photo.

    Raises:
        InputError, UnavailableError: it can't be read, as `size_of`.
    """
    import cv2

    decoder, _ = _opened(path, None)
    levels = colour.to_8_bit(decoder.pixels(path, grey=True))
    return levels if levels.ndim == 2 else np.asarray(cv2.cvtColor(levels, cv2.COLOR_RGB2GRAY))


def read_photo(view: View) -> U8:
    """RGB (H, W, 3) of a view's photo.

    Raises:
        InputError: it can't be read, or its size differs from its camera's.
    """
    return _check_camera_size(view, view.photo, read_rgb(view.photo))


def usable_photo(view: View) -> U8 | None:
    """RGB (H, W, 3) of a view's photo; None if it is unusable (the step `views` reports such photos)."""
    with suppress(InputError):
        return read_photo(view)
    return None


def usable_levels(view: View) -> U8 | None:
    """Grey levels (H, W) of a view's photo; None if it is unusable."""
    with suppress(InputError):
        return _check_camera_size(view, view.photo, read_levels(view.photo))
    return None


def read_mask(view: View) -> U8 | None:
    """The view's mask (H, W), 0 where its photo must not be used; None if it has none.

    Raises:
        InputError: it can't be read, or its size differs from its camera's.
    """
    return None if view.mask is None else _check_camera_size(view, view.mask, read_levels(view.mask))


def write(path: Path, image: U8, *, quality: int = 90) -> None:
    """Write (H, W, 3) RGB or (H, W) grey; `quality` applies to JPEG.

    PNG is run-length encoded differences between rows: texture pages are written and read in half the time of OpenCV's
    defaults, at the same size.

    Raises:
        OSError: nothing could be written; OpenCV doesn't give the cause, usually the disk is full.
    """
    import cv2

    pixels = cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.ndim == 3 else np.ascontiguousarray(image)
    jpeg = path.suffix.lower() in (".jpg", ".jpeg")
    options = [cv2.IMWRITE_JPEG_QUALITY, quality] if jpeg else _png_options()
    if not cv2.imwrite(str(path), pixels, options):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))


def _png_options() -> list[int]:
    import cv2

    options = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]
    if hasattr(cv2, "IMWRITE_PNG_FILTER"):  # OpenCV before 4.12 chooses a filter itself
        options += [cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP]
    return options


def _decoder(path: Path) -> Decoder:
    file_checks.check(path)
    decoder = _module(path)
    require(str(path), *plugins.needs(decoder))
    return decoder


def _module(path: Path) -> Decoder:
    decoder: Decoder = plugins.module(decoders.__name__, DECODERS.get(path.suffix.lower(), "opencv"))
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
        cause = f"has {width:,} x {height:,} pixels, more than {MAX_PIXELS:,}"
        raise InputError(path, cause, "Give a smaller image")


def _check_camera_size(view: View, path: Path, pixels: U8) -> U8:
    expected, size = (view.camera.width, view.camera.height), pixels.shape[1::-1]
    if size != expected:
        cause = f"is {size[0]} x {size[1]} pixels, but its camera {expected[0]} x {expected[1]}"
        raise InputError(path, cause, "Fix the camera's `size` (and focal, centre), or resize the photo")
    return pixels
