"""Data augmentation: colours, labels and lidar channels stay aligned, and channels are only ever degraded."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.segmentation.lidar_channels import DOWNSAMPLING
from scan2sim.segmentation.training.augment import NO_CHANNELS_SHARE, augment, degrade_channels, photometric

CROP = (128, 192)


def scene(height: int, width: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertical stripes of classes, alternately dark and light, and channels that encode the class."""
    classes = np.tile((np.arange(width) // 24 % 6).astype(np.uint8), (height, 1))
    rgb = np.repeat(np.where(classes % 2 == 0, 30, 220).astype(np.uint8)[..., None], 3, axis=2)
    coarse = classes[DOWNSAMPLING // 2 :: DOWNSAMPLING, DOWNSAMPLING // 2 :: DOWNSAMPLING]
    channels = np.stack([20 + 10 * coarse, 0 * coarse + 60, 0 * coarse + 128, 0 * coarse + 255], axis=-1)
    return rgb, classes, channels.astype(np.uint8)


@pytest.mark.parametrize("size", [(384, 512), (128, 768)])
def test_colours_labels_and_channels_stay_aligned(size: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    scan, contrast = [], []
    for _ in range(12):
        seen, truth = augment(*scene(*size), CROP, rng)
        assert seen.shape == (*CROP, 7) and truth.shape == CROP and truth.dtype == np.int64
        assert seen.dtype == np.float32 and seen.min() >= 0 and seen.max() <= 1
        grey = seen[..., :3].mean(axis=2)
        contrast.append(grey[truth % 2 == 1].mean() > grey[truth % 2 == 0].mean())
        valid = seen[..., 6] > 0
        if valid.any():
            scan.append((np.abs((255 * seen[..., 3] - 20) / 10 - truth) < 1.5)[valid].mean())
    assert np.mean(contrast) > 0.8 and np.mean(scan) > 0.8


def test_channels_stay_empty_without_a_scan() -> None:
    rng = np.random.default_rng(1)
    _, classes, channels = scene(256, 256)
    channels[:20], coarse = 0, classes[2::4, 2::4]
    some = [degrade_channels(channels, coarse, rng) for _ in range(80)]
    assert all((one[:18] == 0).all() for one in some), "shifted by at most one pixel"
    assert all((one[one[..., 3] == 0] == 0).all() for one in some)
    without = np.mean([not one.any() for one in some])
    assert NO_CHANNELS_SHARE - 0.15 < without < NO_CHANNELS_SHARE + 0.2


def test_photometric_augmentation_is_random() -> None:
    rng = np.random.default_rng(2)
    image = np.full((64, 96, 3), 120, np.uint8)
    a, b = (photometric(image, np.zeros((64, 96), np.uint8), rng) for _ in range(2))
    assert a.shape == image.shape and a.dtype == np.float32 and np.abs(a - b).mean() > 0.01
