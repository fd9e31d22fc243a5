"""Photos and pictures, through OpenCV: pixels as they lie in the file, RGB."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.errors import InputError
from scan2sim.pipeline.types import U8, View


def read_rgb(path: Path) -> U8 | None:
    """(H, W, 3) RGB, the camera's orientation flag ignored (poses and sizes are of the pixels); None if unreadable."""
    import cv2

    image = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return None if image is None else np.ascontiguousarray(image[..., ::-1])


def read_grey(path: Path) -> U8:
    """(H, W) grey levels of a picture that an earlier step wrote.

    Raises:
        InputError: it can't be read.
    """
    import cv2

    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise InputError(path, "can't be read as an image", "Delete the folder it is in, and run again")
    return np.asarray(image, np.uint8)


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
    import cv2

    mask: Any = cv2.imread(str(view.mask), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    return mask if mask is not None and mask.shape == (view.camera.height, view.camera.width) else None
