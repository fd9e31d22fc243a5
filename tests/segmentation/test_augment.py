"""Photos seen anew: colours, labels and channels stay in register, and no scan tells of more than there is."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.segmentation.lidar_channels import FRACTION
from scan2sim.segmentation.training.augment import WITHOUT, augmented, degraded, photometric

CROP = (128, 192)


def scene(height: int, width: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Upright stripes of classes: dark and light ones by turns, and channels that tell the class."""
    classes = np.tile((np.arange(width) // 24 % 6).astype(np.uint8), (height, 1))
    rgb = np.repeat(np.where(classes % 2 == 0, 30, 220).astype(np.uint8)[..., None], 3, axis=2)
    coarse = classes[FRACTION // 2 :: FRACTION, FRACTION // 2 :: FRACTION]
    channels = np.stack([20 + 10 * coarse, 0 * coarse + 60, 0 * coarse + 128, 0 * coarse + 255], axis=-1)
    return rgb, classes, channels.astype(np.uint8)


@pytest.mark.parametrize("size", [(384, 512), (128, 768)])
def test_colours_labels_and_channels_stay_in_register(size: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    scan, contrast = [], []
    for _ in range(12):
        seen, truth = augmented(*scene(*size), CROP, rng)
        assert seen.shape == (*CROP, 7) and truth.shape == CROP and truth.dtype == np.int64
        assert seen.dtype == np.float32 and seen.min() >= 0 and seen.max() <= 1
        grey = seen[..., :3].mean(axis=2)
        contrast.append(grey[truth % 2 == 1].mean() > grey[truth % 2 == 0].mean())
        there = seen[..., 6] > 0
        if there.any():
            scan.append((np.abs((255 * seen[..., 3] - 20) / 10 - truth) < 1.5)[there].mean())
    assert np.mean(contrast) > 0.8 and np.mean(scan) > 0.8


def test_a_scan_is_never_told_of_where_there_is_none() -> None:
    rng = np.random.default_rng(1)
    _, classes, channels = scene(256, 256)
    channels[:20], coarse = 0, classes[2::4, 2::4]
    some = [degraded(channels, coarse, rng) for _ in range(80)]
    assert all((one[:18] == 0).all() for one in some), "rolled by a pixel at most"
    assert all((one[one[..., 3] == 0] == 0).all() for one in some)
    without = np.mean([not one.any() for one in some])
    assert WITHOUT - 0.15 < without < WITHOUT + 0.2


def test_looks_differ_each_time() -> None:
    rng = np.random.default_rng(2)
    image = np.full((64, 96, 3), 120, np.uint8)
    a, b = (photometric(image, np.zeros((64, 96), np.uint8), rng) for _ in range(2))
    assert a.shape == image.shape and a.dtype == np.float32 and np.abs(a - b).mean() > 0.01
