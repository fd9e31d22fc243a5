"""A network over a photo of any lens and size: one angular resolution, tiles, panoramas wrapped around."""

from __future__ import annotations

import math

import numpy as np

from scan2sim.pipeline.core.types import F32, U8, Camera
from scan2sim.segmentation.backends import Network
from scan2sim.segmentation.labels import CLASSES, IGNORED, mapped
from scan2sim.segmentation.lidar_channels import COUNT

TILE = 1536
"""Pixels of the largest tile's side that a network is given at once."""
OVERLAP = 128
"""Pixels that tiles share: what is nearer to a border lacks context."""
SMALLEST = 256
"""Pixels below which tiles aren't made smaller for want of memory."""
STRIDE = 4
"""Probabilities are kept at this fraction of the pixels classified."""
ENLARGED = 1.6
"""Photos are enlarged at most so many times."""


class Classifier:
    """Classifies the pixels of photos by a network.

    Args:
        network: loaded.
        where: its weights' file, for messages.

    Attributes:
        takes_channels: whether it takes what a scan measures at a photo's pixels, too.
        tile: pixels of a tile's side; made smaller when a device runs out of memory.
    """

    def __init__(self, network: Network, where: str) -> None:
        self._network = network
        to = mapped(network.facts.labels, where)
        self._merge = np.zeros((len(CLASSES), len(to)), np.float32)
        self._merge[to[to != IGNORED], np.flatnonzero(to != IGNORED)] = 1
        self.classes = tuple(name for name, row in zip(CLASSES, self._merge, strict=True) if row.any())
        self.takes_channels = network.facts.channels
        self.tile = TILE

    def probabilities(self, rgb: U8, camera: Camera, channels: U8 | None = None) -> U8:
        """(h, w, C) uint8, 255 for 1, by class of `CLASSES`, at about a `STRIDE`-th of the pixels classified.

        Args:
            rgb: (H, W, 3) of the whole photo.
            camera: its intrinsics.
            channels: (h, w, 4) of the same photo, as `segmentation.lidar_channels`; None where there is no scan.
        """
        import cv2

        wide = camera.model == "equirectangular"
        size = self.size(camera)
        image = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA if size[0] < camera.width else cv2.INTER_LINEAR)
        if self.takes_channels:
            if channels is None:
                channels = np.zeros((1, 1, COUNT), np.uint8)
            image = np.concatenate([image, cv2.resize(channels, size, interpolation=cv2.INTER_NEAREST)], axis=2)
        margin = OVERLAP if wide else 0
        if wide:  # the seam is no special place
            image = np.concatenate([image[:, -margin:], image, image[:, :margin]], axis=1)
        whole = self._in_tiles(np.ascontiguousarray(image))
        cut = margin // STRIDE
        return whole[:, cut : whole.shape[1] - cut] if wide else whole

    def size(self, camera: Camera) -> tuple[int, int]:
        """Width and height at which a photo is classified."""
        wanted, factor = self._network.facts.pixels_a_radian, 1.0
        if wanted is not None:
            has = camera.width / (2 * math.pi) if camera.model == "equirectangular" else min(camera.fx, camera.fy)
            factor = min(wanted / has, ENLARGED)
        return max(32, round(camera.width * factor)), max(32, round(camera.height * factor))

    def _in_tiles(self, image: U8) -> U8:
        height, width = image.shape[:2]
        out = np.zeros((max(1, height // STRIDE), max(1, width // STRIDE), len(CLASSES)), np.float32)
        weight = np.zeros(out.shape[:2], np.float32)
        while True:
            try:
                for top in _starts(height, self.tile):
                    for left in _starts(width, self.tile):
                        self._one(image, top, left, out, weight)
                break
            except MemoryError:
                if self.tile // 2 < SMALLEST:
                    raise
                self.tile //= 2
                out[:], weight[:] = 0, 0
        return np.asarray(np.clip(out / np.maximum(weight, 1e-6)[..., None] * 255 + 0.5, 0, 255), np.uint8)

    def _one(self, image: U8, top: int, left: int, out: F32, weight: F32) -> None:
        """Add a tile's probabilities, which count less towards its borders."""
        import cv2

        part = image[top : top + self.tile, left : left + self.tile]
        found = self._network.probabilities(part)
        merged = np.tensordot(self._merge, found, axes=1).transpose(1, 2, 0)
        y, x = top // STRIDE, left // STRIDE
        h, w = min(part.shape[0] // STRIDE, out.shape[0] - y), min(part.shape[1] // STRIDE, out.shape[1] - x)
        merged = np.stack([cv2.resize(merged[..., k], (w, h)) for k in range(merged.shape[2])], axis=-1)
        ramp = np.minimum.outer(_ramp(h), _ramp(w)).astype(np.float32)
        out[y : y + h, x : x + w] += merged * ramp[..., None]
        weight[y : y + h, x : x + w] += ramp


def _starts(length: int, tile: int) -> list[int]:
    """Where tiles begin that cover a length, sharing `OVERLAP` at least; multiples of `STRIDE`."""
    if length <= tile:
        return [0]
    n = math.ceil((length - OVERLAP) / (tile - OVERLAP))
    return [int((length - tile) * i / (n - 1)) // STRIDE * STRIDE for i in range(n)]


def _ramp(n: int) -> F32:
    at = np.arange(n) + 0.5
    return np.minimum(1.0, np.minimum(at, n - at) / (OVERLAP / STRIDE / 2)).astype(np.float32)


def class_map(probabilities: U8, size: tuple[int, int]) -> tuple[U8, U8]:
    """Index of the likeliest class, and its probability (255 for 1), of every pixel: (H, W) each.

    Args:
        probabilities: (h, w, C) of `Classifier.probabilities`.
        size: (H, W) of the photo.
    """
    import cv2

    best, sure = np.zeros(size, np.uint8), np.zeros(size, np.uint8)
    for k in range(probabilities.shape[2]):
        layer = cv2.resize(probabilities[..., k], size[::-1], interpolation=cv2.INTER_LINEAR)
        better = layer > sure
        best[better], sure[better] = k, layer[better]
    return best, sure
