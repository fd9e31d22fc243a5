"""Photos and pictures, through OpenCV: pixels as they lie in the file, RGB."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.errors import InputError
from scan2sim.pipeline.io import files
from scan2sim.pipeline.types import U8, View

MAX_PIXELS = 2**29
"""Of a photo: 32,768 x 16,384. What says it has more is taken for a decompression bomb."""
AGAIN = "Copy it again, or leave it out"


def size_of(path: Path) -> tuple[int, int]:
    """Width and height of a photo, pixels, as its header says.

    Raises:
        InputError: it is missing, no file, no image, or larger than `MAX_PIXELS`.
    """
    files.check(path)
    with opened(path) as image:
        width, height = image.size
    if width * height > MAX_PIXELS:
        told = f"is of {width:,} x {height:,} pixels, more than {MAX_PIXELS:,}"
        raise InputError(path, told, "Give a smaller one")
    return width, height


def check_decodes(path: Path) -> None:
    """Decode a photo; a JPEG at an eighth, which tells enough.

    Raises:
        InputError: it can't be.
    """
    with opened(path) as image:
        image.draft(None, (image.size[0] // 8, image.size[1] // 8))
        image.load()


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """A photo by Pillow, its header read.

    Raises:
        InputError: it can't be read, here or while it is open.
    """
    from PIL import Image

    Image.MAX_IMAGE_PIXELS = None  # `MAX_PIXELS` is the limit: Pillow's own is below what 360 cameras make
    try:
        with Image.open(path) as image:
            yield image
    except Exception as error:  # its decoders raise whatever the damage leads to
        raise InputError(path, f"can't be read ({error})", AGAIN) from None


def read_rgb(path: Path) -> U8 | None:
    """(H, W, 3) RGB, the camera's orientation flag ignored (poses and sizes are of the pixels); None if unreadable."""
    image = _decoded(path, "IMREAD_COLOR")
    return None if image is None else np.ascontiguousarray(image[..., ::-1])


def read_levels(path: Path) -> U8 | None:
    """(H, W) grey levels, orientation ignored likewise; None if unreadable."""
    return _decoded(path, "IMREAD_GRAYSCALE")


def _decoded(path: Path, how: str) -> Any:
    import cv2

    try:
        size_of(path)
        return cv2.imread(str(path), getattr(cv2, how) | cv2.IMREAD_IGNORE_ORIENTATION)
    except (InputError, cv2.error):
        return None


def read_grey(path: Path) -> U8:
    """(H, W) grey levels of a picture that an earlier step wrote.

    Raises:
        InputError: it can't be read.
    """
    image = read_levels(path)
    if image is None:
        raise InputError(path, "can't be read as an image", "Delete the folder it is in, and run again")
    return image


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


def copy(source: Path, path: Path, *, quality: int = 90) -> None:
    """Write a picture of an earlier step in another format, as `write`.

    Raises:
        InputError: it can't be read.
    """
    pixels = read_rgb(source)
    if pixels is None:
        raise InputError(source, "can't be read as an image", "Delete the folder it is in, and run again")
    write(path, pixels, quality=quality)


def read_mask(view: View) -> U8 | None:
    """The view's mask (H, W), 0 where its photo must not be used; None if it can't be read or is of another size."""
    mask = read_levels(view.mask) if view.mask else None
    return mask if mask is not None and mask.shape == (view.camera.height, view.camera.width) else None
