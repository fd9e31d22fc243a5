"""MS-SSIM against values of another implementation, against its formula, and with a mask."""

import math

import cv2
import numpy as np
import pytest

from scan2sim.pipeline.core.types import U8
from scan2sim.texturing.ms_ssim import WEIGHTS, ms_ssim


def photo() -> U8:
    """(192, 256, 3) grey waves."""
    y, x = np.mgrid[0:192, 0:256]
    wave = np.clip(128 + 60 * np.sin(x / 9) + 50 * np.cos(y / 17), 0, 255)
    return np.repeat(wave[..., None], 3, axis=2).astype(np.uint8)


def noisy() -> U8:
    noise = np.random.default_rng(0).normal(0, 25, (192, 256, 1))
    return np.clip(photo() + noise, 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        (noisy(), 0.850247),
        (cv2.GaussianBlur(noisy(), (0, 0), 2).astype(np.uint8), 0.989824),
        (np.roll(photo(), 4, axis=1), 0.905867),
        ((photo() * 0.7).astype(np.uint8), 0.937636),
    ],
    ids=["noise", "blurred noise", "shifted by 4 pixels", "darker"],
)
def test_values_are_those_of_pytorch_msssim(changed: U8, expected: float) -> None:
    """Reference: pytorch-msssim 1.0.0 on the grey images, data_range 255."""
    assert ms_ssim(photo(), changed) == pytest.approx(expected, abs=1e-5)


def test_constant_images_differ_only_by_the_luminance_term() -> None:
    a, b = (np.full((192, 192, 3), level, np.uint8) for level in (100, 150))
    c1 = (0.01 * 255) ** 2
    luminance = (2 * 100 * 150 + c1) / (100**2 + 150**2 + c1)
    assert ms_ssim(a, b) == pytest.approx(luminance ** WEIGHTS[-1], abs=1e-4)


def test_masked_pixels_have_no_effect() -> None:
    mask = np.ones((384, 512), bool)
    mask[100:180, 120:300] = False
    clean, changed = (np.tile(image, (2, 2, 1)) for image in (photo(), noisy()))
    spoiled = np.where(mask[..., None], changed, 255 - clean)
    expected = ms_ssim(clean, changed)
    assert ms_ssim(clean, spoiled, mask) == pytest.approx(expected, abs=0.03)
    assert ms_ssim(clean, spoiled) < expected - 0.15
    assert ms_ssim(clean, clean, mask) == pytest.approx(1)


def test_small_images_and_empty_masks_have_no_value() -> None:
    assert math.isnan(ms_ssim(photo()[:170], photo()[:170]))
    assert math.isnan(ms_ssim(photo(), photo(), np.zeros((192, 256), bool)))
