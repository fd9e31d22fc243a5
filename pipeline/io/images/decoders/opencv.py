"""OpenCV: JPEG, PNG, WebP and BMP; headers, and a quick look through a JPEG, by Pillow."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.io.images.decoders import AGAIN, Box, Header

SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".bmp")
PARTS = False


def header(path: Path) -> Header:
    """See `pipeline.io.images.decoders.Decoder`."""
    with opened(path) as image:
        return Header(image.size[0], image.size[1], image.info.get("icc_profile"))


def check(path: Path) -> None:
    """See `pipeline.io.images.decoders.Decoder`; a JPEG at an eighth."""
    with opened(path) as image:
        image.draft(None, (image.size[0] // 8, image.size[1] // 8))
        image.load()


def pixels(path: Path, grey: bool = False, box: Box | None = None) -> npt.NDArray[Any]:
    """See `pipeline.io.images.decoders.Decoder`."""
    import cv2

    how = (cv2.IMREAD_GRAYSCALE if grey else cv2.IMREAD_COLOR) | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        found = cv2.imread(str(path), how)
    except cv2.error as error:
        raise InputError(path, f"can't be read ({error.err})", AGAIN) from None
    if found is None:
        raise InputError(path, "can't be read (no picture of a known kind, or damaged)", AGAIN)
    x0, y0, x1, y1 = box or (0, 0, found.shape[1], found.shape[0])
    part = found[y0:y1, x0:x1]
    return np.ascontiguousarray(part if grey else part[..., ::-1])


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """A photo by Pillow, its header read.

    Raises:
        InputError: it can't be read, here or while it is open.
    """
    from PIL import Image, UnidentifiedImageError

    Image.MAX_IMAGE_PIXELS = None  # `image.MAX_PIXELS` is the limit: Pillow's own is below what 360 cameras make
    try:
        with Image.open(path) as image:
            yield image
    except UnidentifiedImageError:  # it cites the path alone
        raise InputError(path, "can't be read (no picture of a known kind, or damaged)", AGAIN) from None
    except Exception as error:  # its decoders raise whatever the damage leads to
        raise InputError(path, f"can't be read ({error})", AGAIN) from None
