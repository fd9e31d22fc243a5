"""Pixels of any depth and colour space to 8-bit sRGB."""

from __future__ import annotations

import io
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import U8

SAME = 2
"""Levels by which profiles of sRGB differ among each other, at most."""


def to_8_bit(pixels: npt.NDArray[Any]) -> U8:
    """Levels of a picture (H, W[, C]).

    uint8: as it is. uint16: its share of 65535. Floats are linear light, 1 is white, and get sRGB's curve
    (IEC 61966-2-1); what is brighter is clipped, as is what is no number.
    """
    if pixels.dtype == np.uint8:
        return pixels
    if pixels.dtype == np.uint16:
        return _shares()[pixels]
    light = np.nan_to_num(pixels, nan=0.0, posinf=1.0, neginf=0.0).clip(0, 1)
    return _encoded()[np.rint(light * 65535).astype(np.uint16)]


@lru_cache(maxsize=1)
def _shares() -> U8:
    return np.rint(np.arange(65536) / 257).astype(np.uint8)


@lru_cache(maxsize=1)
def _encoded() -> U8:
    x = np.arange(65536) / 65535
    return np.rint(255 * np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)).astype(np.uint8)


def to_srgb(rgb: U8, profile: bytes) -> U8:
    """A picture (H, W, 3) in sRGB, by LittleCMS, relative colorimetric.

    A profile of sRGB, and one of other than RGB pixels (CMYK, which decoders have made RGB of), changes nothing.

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
    """LittleCMS's, from a profile to sRGB; None: there is nothing to do."""
    from PIL import Image, ImageCms

    try:
        own = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        if own.profile.xcolor_space.strip() != "RGB":
            return None
        srgb, intent = ImageCms.createProfile("sRGB"), ImageCms.Intent.RELATIVE_COLORIMETRIC
        transform = ImageCms.buildTransform(own, srgb, "RGB", "RGB", intent)
        levels = np.linspace(0, 255, 9).astype(np.uint8)
        probe = np.stack(np.meshgrid(levels, levels, levels), axis=-1).reshape(9, 81, 3)
        there = np.asarray(ImageCms.applyTransform(Image.fromarray(probe), transform))
    except (ImageCms.PyCMSError, OSError) as error:
        raise ValueError(error) from error
    return None if np.abs(there.astype(int) - probe).max() <= SAME else transform
