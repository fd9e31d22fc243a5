"""Conversion of pixels of any bit depth and colour space to 8-bit sRGB."""

from __future__ import annotations

import io
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import U8

SRGB_TOLERANCE = 2
"""Levels (of 255) by which different ICC profiles of sRGB differ from each other at most."""


def to_8_bit(pixels: npt.NDArray[Any]) -> U8:
    """Convert the pixels of an image (H, W[, C]) to 8 bits.

    uint8 is returned unchanged, uint16 is divided by 257. Floats are linear light with 1 as white and get sRGB's
    transfer function (IEC 61966-2-1); brighter values are clipped, NaN becomes 0.
    """
    if pixels.dtype == np.uint8:
        return pixels
    if pixels.dtype == np.uint16:
        return _uint16_to_uint8()[pixels]
    light = np.nan_to_num(pixels, nan=0.0, posinf=1.0, neginf=0.0).clip(0, 1)
    return _linear_to_srgb()[np.rint(light * 65535).astype(np.uint16)]


@lru_cache(maxsize=1)
def _uint16_to_uint8() -> U8:
    return np.rint(np.arange(65536) / 257).astype(np.uint8)


@lru_cache(maxsize=1)
def _linear_to_srgb() -> U8:
    x = np.arange(65536) / 65535
    return np.rint(255 * np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)).astype(np.uint8)


def to_srgb(rgb: U8, profile: bytes) -> U8:
    """Convert an image (H, W, 3) from its ICC profile to sRGB with LittleCMS, relative colorimetric.

    Profiles of sRGB, and of other than RGB pixels (CMYK, which decoders have already converted), change nothing.

    Raises:
        ValueError: the profile can't be read.
    """
    from PIL import Image, ImageCms

    transform = _transform(profile)
    if transform is None:
        return rgb
    return np.asarray(ImageCms.applyTransform(Image.fromarray(rgb), transform))


@lru_cache(maxsize=8)
def _transform(profile: bytes) -> Any:
    """LittleCMS transform from a profile to sRGB; None if it would change nothing."""
    from PIL import Image, ImageCms

    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        if source.profile.xcolor_space.strip() != "RGB":
            return None
        srgb, intent = ImageCms.createProfile("sRGB"), ImageCms.Intent.RELATIVE_COLORIMETRIC
        transform = ImageCms.buildTransform(source, srgb, "RGB", "RGB", intent)
        levels = np.linspace(0, 255, 9).astype(np.uint8)
        probe = np.stack(np.meshgrid(levels, levels, levels), axis=-1).reshape(9, 81, 3)
        transformed = np.asarray(ImageCms.applyTransform(Image.fromarray(probe), transform))
    except (ImageCms.PyCMSError, OSError) as error:
        raise ValueError(error) from error
    return None if np.abs(transformed.astype(int) - probe).max() <= SRGB_TOLERANCE else transform
