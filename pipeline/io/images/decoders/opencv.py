"""OpenCV decoder: JPEG, PNG, WebP and BMP; headers and the quick check of a JPEG by Pillow."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.io.images.decoders import COPY_AGAIN, Box, Header

SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".bmp")
PARTS = False


def header(path: Path) -> Header:
    """See `pipeline.io.images.decoders.Decoder`."""
    with opened(path) as image:
        return Header(image.size[0], image.size[1], image.info.get("icc_profile"))


def check(path: Path) -> None:
    """See `pipeline.io.images.decoders.Decoder`; a JPEG is decoded at 1/8 of its size."""
    with opened(path) as image:
        image.draft(None, (image.size[0] // 8, image.size[1] // 8))
        image.load()


def pixels(path: Path, grey: bool = False, box: Box | None = None) -> npt.NDArray[Any]:
    """See `pipeline.io.images.decoders.Decoder`."""
    import cv2

    flags = (cv2.IMREAD_GRAYSCALE if grey else cv2.IMREAD_COLOR) | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        found = cv2.imread(str(path), flags)
    except cv2.error as error:
        raise InputError(path, f"can't be read ({error.err})", COPY_AGAIN) from None
    if found is None:
        raise InputError(path, "can't be read (unknown image format, or damaged)", COPY_AGAIN)
    x0, y0, x1, y1 = box or (0, 0, found.shape[1], found.shape[0])
    part = found[y0:y1, x0:x1]
    return np.ascontiguousarray(part) if grey else np.asarray(cv2.cvtColor(part, cv2.COLOR_BGR2RGB))


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """Open an image with Pillow, which reads the header.

    Raises:
        InputError: it can't be read, now or inside the `with` block.
    """
    from PIL import Image, UnidentifiedImageError

    Image.MAX_IMAGE_PIXELS = (
        None  # `image.MAX_PIXELS` is the limit: Pillow's own is below the size of 360-degree photos
    )
    try:
        with Image.open(path) as image:
            yield image
    except UnidentifiedImageError:  # its message is only the path
        raise InputError(path, "can't be read (unknown image format, or damaged)", COPY_AGAIN) from None
    except Exception as error:  # damaged files make its decoders raise any type of exception
        raise InputError(path, f"can't be read ({error})", COPY_AGAIN) from None
