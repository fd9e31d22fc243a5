"""Data augmentation (domain randomization): keeps a network from learning properties of the renderer.

Colours are varied as by light, lens, sensor and image processing, and beyond; lidar channels
(`segmentation.lidar_channels`) are degraded as in real scans.
"""

from __future__ import annotations

import math

import numpy as np

from scan2sim.pipeline.core.types import F32, I64, U8
from scan2sim.segmentation.labels import CLASSES
from scan2sim.segmentation.lidar_channels import DOWNSAMPLING, MAX_DISTANCE_M, MIN_DISTANCE_M, encode_height

Rng = np.random.Generator

NO_CHANNELS_SHARE = 0.25
"""Share of the crops without lidar channels, as for photos without a scan."""


def augment(rgb: U8, classes: U8, channels: U8, crop: tuple[int, int], rng: Rng) -> tuple[F32, I64]:
    """Random crop of a photo with its augmentations: input (h, w, 7) in [0, 1], class indices (h, w).

    Args:
        rgb: (H, W, 3) photo.
        classes: (H, W) class indices.
        channels: (H / 4, W / 4, 4) lidar channels.
        crop: (h, w) size of the crop.
        rng: random number generator.
    """
    import cv2

    h, w = crop
    scale = max(float(np.exp(rng.uniform(np.log(0.7), np.log(1.5)))), h / rgb.shape[0], w / rgb.shape[1])
    need = [math.ceil(side / scale / DOWNSAMPLING) for side in crop]
    top, left = (
        int(rng.integers(0, side // DOWNSAMPLING - n + 1)) for side, n in zip(rgb.shape[:2], need, strict=True)
    )
    small = np.s_[top : top + need[0], left : left + need[1]]
    full = tuple(slice(DOWNSAMPLING * s.start, DOWNSAMPLING * s.stop) for s in small)
    image = cv2.resize(rgb[full], (w, h), interpolation=cv2.INTER_LINEAR if scale > 1 else cv2.INTER_AREA)
    truth = cv2.resize(classes[full], (w, h), interpolation=cv2.INTER_NEAREST)
    coarse = np.ascontiguousarray(classes[full][DOWNSAMPLING // 2 :: DOWNSAMPLING, DOWNSAMPLING // 2 :: DOWNSAMPLING])
    scan = cv2.resize(degrade_channels(channels[small], coarse, rng), (w, h), interpolation=cv2.INTER_NEAREST)
    if rng.random() < 0.5:
        image, truth, scan = image[:, ::-1], truth[:, ::-1], scan[:, ::-1]
    seen = np.concatenate([photometric(image, truth, rng), scan.astype(np.float32) / 255], axis=2)
    return np.ascontiguousarray(seen), np.ascontiguousarray(truth, np.int64)


def degrade_channels(channels: U8, classes: U8, rng: Rng) -> U8:
    """Lidar channels (h, w, 4) as from a real scan: limited height and range, holes, noise, no moving objects."""
    if rng.random() < NO_CHANNELS_SHARE:
        return np.zeros_like(channels)
    shape = classes.shape
    down, right = rng.integers(-1, 2, 2)  # small errors of the poses
    x = np.pad(channels.astype(np.float32), ((1, 1), (1, 1), (0, 0)))[1 - down :, 1 - right :][: shape[0], : shape[1]]
    valid = x[..., 3] > 0
    far = x[..., 1] / 255
    # lidars have a small field of view upwards
    max_height = rng.choice([rng.uniform(1.5, 5), rng.uniform(5, 15), 1e3], p=[0.5, 0.25, 0.25])
    valid &= x[..., 0] < encode_height(np.full(1, max_height, np.float32)) + rng.normal(0, 4, shape)
    valid &= far < np.log(rng.uniform(25, MAX_DISTANCE_M) / MIN_DISTANCE_M) / np.log(MAX_DISTANCE_M / MIN_DISTANCE_M)
    valid &= rng.random(shape) > rng.uniform(0, 0.25) + rng.uniform(0, 0.6) * far**3
    valid &= _blotches(shape, 10, rng) > rng.uniform(-3.0, -1.2)
    for name, share in (("person", 0.7), ("vehicle", 0.15)):
        if rng.random() < share:
            valid &= classes != CLASSES.index(name)
    x[..., 0] += rng.normal(0, rng.uniform(0, 4), shape) + rng.uniform(0, 5) * _blotches(shape, 40, rng)
    x[..., 1] += rng.normal(0, 1, shape)
    x[..., 2] = np.abs(x[..., 2] + rng.normal(0, rng.uniform(0, 50), shape))
    return np.where(valid[..., None], np.clip(x, 0, 255), 0).astype(np.uint8)


def _blotches(shape: tuple[int, ...], size: float, rng: Rng) -> F32:
    """(h, w) smooth noise of about unit standard deviation, with blotches about `size` pixels wide."""
    import cv2

    coarse = rng.standard_normal((math.ceil(shape[0] / size) + 2, math.ceil(shape[1] / size) + 2), np.float32)
    blotches = cv2.resize(coarse, None, fx=size, fy=size, interpolation=cv2.INTER_CUBIC)
    top, left = (int(rng.integers(0, blotches.shape[k] - shape[k] + 1)) for k in range(2))
    return np.asarray(blotches[top : top + shape[0], left : left + shape[1]], np.float32)


def photometric(image: U8, truth: U8, rng: Rng) -> F32:
    """Photometric augmentation: other surface colours, shadows and another camera; (h, w, 3) in [0, 1]."""
    x: F32 = np.power(image.astype(np.float32) / 255, np.float32(2.2))
    if rng.random() < 0.4:
        x = recolour_classes(x, truth, rng)
    if rng.random() < 0.4:
        x = add_shadows(x, rng)
    return simulate_camera(x, rng)


def recolour_classes(light: F32, truth: U8, rng: Rng) -> F32:
    """Some classes with other colours and additional texture, as colour alone must not identify a class."""
    for k in rng.permutation(len(CLASSES))[:4]:
        on = truth == k
        if CLASSES[k] == "sky" or not on.any():
            continue
        tint = np.exp(rng.normal(0, 0.5) + rng.normal(0, 0.25, 3)).astype(np.float32)
        grain = sum(rng.uniform(0, 0.25) * _blotches(truth.shape, size, rng) for size in (2, 7, 30))
        light = np.where(on[..., None], light * tint * np.exp(np.asarray(grain, np.float32))[..., None], light)
    return light


def add_shadows(light: F32, rng: Rng) -> F32:
    """Large or dappled shadows with soft or hard edges, such as those of trees."""
    blotches = _blotches(light.shape[:2], float(np.exp(rng.uniform(np.log(6), np.log(150)))), rng)
    edge = np.clip((blotches - rng.uniform(-1, 1)) / rng.uniform(0.05, 1.0) + 0.5, 0, 1)
    depth = rng.uniform(0.15, 0.8)
    blue = np.array([1.0, 1.05, 1.2], np.float32) * np.float32(depth)
    return light * (edge[..., None] + (1 - edge[..., None]) * blue)


def simulate_camera(light: F32, rng: Rng) -> F32:
    """A random camera: exposure, white balance, glare, noise, clipping, tone curve, saturation, blur, compression."""
    import cv2

    x = light * np.exp(rng.normal(0, 0.07, 3) + rng.normal(0.1, 0.55)).astype(np.float32)
    if rng.random() < 0.3:
        x = x + np.float32(rng.uniform(0, 0.12)) * cv2.GaussianBlur(np.clip(x, 0, 1), (0, 0), 25)  # glare
    noise = np.float32(rng.choice([0.0, rng.uniform(0, 0.05)]))
    if noise:  # noise of a Bayer sensor: colours are coarser than brightness
        h, w = x.shape[:2]
        grain = cv2.resize(rng.standard_normal((-(-h // 2), -(-w // 2), 3), np.float32), (w, h))
        grain = 0.6 * grain + 0.5 * rng.standard_normal((h, w, 1), np.float32)
        x = x + noise * grain * np.sqrt(np.clip(x, 0.01, 1))
    x = np.clip(x, 0, 1)
    x = x ** np.float32(np.exp(rng.normal(np.log(1 / 2.2), 0.15)))
    if rng.random() < 0.6:  # S-shaped tone curve
        bend = np.float32(rng.uniform(0, 1.0))
        x = (1 - bend) * x + bend * (x * x * (3 - 2 * x))
    black = np.float32(rng.choice([0.0, rng.uniform(-0.06, 0.12)]))
    x = np.clip((x - black) / (1 - black), 0, 1)
    grey = x.mean(axis=2, keepdims=True)
    x = grey + (x - grey) * np.float32(rng.uniform(0.2, 1.6))
    blur = rng.random()
    if blur < 0.3:
        x = cv2.GaussianBlur(x, (0, 0), float(rng.uniform(0.3, 1.5)))
    elif blur < 0.6:  # sharpened
        x = x + np.float32(rng.uniform(0.2, 1.5)) * (x - cv2.GaussianBlur(x, (0, 0), float(rng.uniform(0.7, 2.0))))
    x = np.clip(x, 0, 1)
    if rng.random() < 0.3:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(30, 90))]
        x = cv2.imdecode(cv2.imencode(".jpg", (x * 255).astype(np.uint8), quality)[1], -1).astype(np.float32) / 255
    return np.asarray(x, np.float32)
