"""Classification of photos by a network: turned upright, angular resampling, tiling, panorama wrap-around."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from scan2sim.pipeline.core.types import F32, U8, Camera, View
from scan2sim.segmentation.backends import Network
from scan2sim.segmentation.labels import CLASSES, IGNORED, map_labels
from scan2sim.segmentation.lidar_channels import CHANNELS

MAX_TILE_PX = 1536
"""Largest side of a tile that a network classifies at once."""
TILE_OVERLAP_PX = 128
"""Overlap of tiles, as pixels near the border of a tile have too little context."""
MIN_TILE_PX = 256
"""Smallest side of tiles to which they are reduced when memory is insufficient."""
OUTPUT_STRIDE = 4
"""Probabilities are stored at 1/4 of the resolution at which photos are classified."""
MAX_UPSCALING = 1.6
"""Largest factor by which photos are enlarged."""
MIN_WARNED_SHARE = 0.03
"""Share of the photos from which a label without a class is worth a warning."""
SIDEWAYS_MIN = 0.5
"""Least cosine between a photo's plane and the vertical; cameras that look more steeply have no upright photo."""


def quarter_turns(view: View) -> int:
    """Counter-clockwise quarter turns (`np.rot90`) that make a photo upright: of a camera on its side, or a portrait.

    0 for panoramas, and for cameras that look almost straight up or down.
    """
    x, y, _ = view.T_world_cam[2, :3]  # up, in the camera's axes
    if view.camera.model == "equirectangular" or math.hypot(x, y) < SIDEWAYS_MIN:
        return 0
    return round(math.atan2(x, -y) / (math.pi / 2)) % 4


class Classifier:
    """Classifies the pixels of photos by a network.

    Args:
        network: network to use.
        where: file of its weights, for error messages.

    Attributes:
        classes: names of the classes that the network predicts.
        takes_channels: whether the network takes lidar channels.
        tile: side of the tiles in pixels; reduced when a device runs out of memory.
    """

    def __init__(self, network: Network, where: str) -> None:
        self._network = network
        index = map_labels(network.info.labels, where)
        self._merge = np.zeros((len(CLASSES), len(index)), np.float32)
        self._merge[index[index != IGNORED], np.flatnonzero(index != IGNORED)] = 1
        self.classes = tuple(name for name, row in zip(CLASSES, self._merge, strict=True) if row.any())
        self.takes_channels = network.info.channels
        self.tile = MAX_TILE_PX
        self._label_shares, self._tiles = np.zeros(len(index)), 0

    def warnings(self) -> list[str]:
        """What was assumed about the network's input, and labels without a class in the photos that it classified."""
        found = [f"{self._network.info.name}: {self._network.info.assumed}"] if self._network.info.assumed else []
        shares = np.where(self._merge.any(axis=0), 0.0, self._label_shares / max(self._tiles, 1))
        frequent = [i for i in np.argsort(-shares).tolist() if shares[i] >= MIN_WARNED_SHARE]
        if frequent:
            names = ", ".join(f"{self._network.info.labels[i]} ({shares[i]:.0%})" for i in frequent[:8])
            found.append(
                f"{self._network.info.name}: labels of the photos that are no class and don't count: {names}. If they "
                f"belong to a class, name them after it: {', '.join(CLASSES)}"
            )
        return found

    def probabilities(self, rgb: U8, camera: Camera, channels: U8 | None = None, turns: int = 0) -> U8:
        """(h, w, C) uint8 probabilities (255 for 1) by class of `CLASSES`, at 1/`OUTPUT_STRIDE` of `size`.

        Args:
            rgb: (H, W, 3) whole photo.
            camera: intrinsics of the photo.
            channels: (h, w, 4) lidar channels of the photo; None if there is no scan.
            turns: quarter turns (`quarter_turns`) by which the photo is turned for the network, and back.
        """
        import cv2

        if turns:
            upright = np.ascontiguousarray(np.rot90(rgb, turns))
            turned = replace(camera, width=upright.shape[1], height=upright.shape[0])
            channels = None if channels is None else np.rot90(channels, turns)
            return np.ascontiguousarray(np.rot90(self.probabilities(upright, turned, channels), -turns))
        wide = camera.model == "equirectangular"
        size = self.size(camera)
        image = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA if size[0] < camera.width else cv2.INTER_LINEAR)
        if self.takes_channels:
            if channels is None:
                channels = np.zeros((1, 1, CHANNELS), np.uint8)
            image = np.concatenate([image, cv2.resize(channels, size, interpolation=cv2.INTER_NEAREST)], axis=2)
        margin = TILE_OVERLAP_PX if wide else 0
        if wide:  # gives pixels at the panorama's seam their context
            image = np.concatenate([image[:, -margin:], image, image[:, :margin]], axis=1)
        whole = self._in_tiles(np.ascontiguousarray(image))
        cut = margin // OUTPUT_STRIDE
        return whole[:, cut : whole.shape[1] - cut] if wide else whole

    def size(self, camera: Camera) -> tuple[int, int]:
        """Width and height at which a photo is classified."""
        wanted, factor = self._network.info.pixels_per_radian, 1.0
        if wanted is not None:
            own = camera.width / (2 * math.pi) if camera.model == "equirectangular" else min(camera.fx, camera.fy)
            factor = min(wanted / own, MAX_UPSCALING)
        return max(32, round(camera.width * factor)), max(32, round(camera.height * factor))

    def _in_tiles(self, image: U8) -> U8:
        height, width = image.shape[:2]
        out = np.zeros((max(1, height // OUTPUT_STRIDE), max(1, width // OUTPUT_STRIDE), len(CLASSES)), np.float32)
        weight = np.zeros(out.shape[:2], np.float32)
        while True:
            tile = self._tile_size(height, width)
            try:
                for top in _starts(height, tile[0]):
                    for left in _starts(width, tile[1]):
                        self._add_tile(image[top : top + tile[0], left : left + tile[1]], top, left, out, weight)
                break
            except MemoryError:
                if self.tile // 2 < MIN_TILE_PX:
                    raise
                self.tile //= 2
                out[:], weight[:] = 0, 0
        return np.asarray(np.clip(out / np.maximum(weight, 1e-6)[..., None] * 255 + 0.5, 0, 255), np.uint8)

    def _tile_size(self, height: int, width: int) -> tuple[int, int]:
        """Height and width of the tiles of an image: of the network's proportions, if its input has a fixed size."""
        fixed = self._network.info.size
        if fixed is None:
            return self.tile, self.tile
        factor = min(self.tile / max(fixed), height / fixed[0], width / fixed[1])

        def side(length: int, own: int) -> int:
            """A multiple of the stride, at which tiles begin, or the whole length: else its last pixels had no tile."""
            n = round(own * factor)
            return length if n >= length else max(1, n // OUTPUT_STRIDE) * OUTPUT_STRIDE

        return side(height, fixed[0]), side(width, fixed[1])

    def _add_tile(self, part: U8, top: int, left: int, out: F32, weight: F32) -> None:
        """Add a tile's probabilities, with weights that fall towards its borders."""
        import cv2

        found = self._network.probabilities(part)
        self._label_shares += found.mean(axis=(1, 2))
        self._tiles += 1
        merged = np.tensordot(self._merge, found, axes=1).transpose(1, 2, 0)
        y, x = top // OUTPUT_STRIDE, left // OUTPUT_STRIDE
        h, w = (
            min(part.shape[0] // OUTPUT_STRIDE, out.shape[0] - y),
            min(part.shape[1] // OUTPUT_STRIDE, out.shape[1] - x),
        )
        merged = np.stack([cv2.resize(merged[..., k], (w, h)) for k in range(merged.shape[2])], axis=-1)
        ramp = np.minimum.outer(_ramp(h), _ramp(w)).astype(np.float32)
        out[y : y + h, x : x + w] += merged * ramp[..., None]
        weight[y : y + h, x : x + w] += ramp


def _starts(length: int, tile: int) -> list[int]:
    """First pixels of tiles that cover a length with an overlap; multiples of `OUTPUT_STRIDE`."""
    if length <= tile:
        return [0]
    overlap = min(TILE_OVERLAP_PX, tile // 2)
    n = math.ceil((length - overlap) / (tile - overlap))
    return [int((length - tile) * i / (n - 1)) // OUTPUT_STRIDE * OUTPUT_STRIDE for i in range(n)]


def _ramp(n: int) -> F32:
    at = np.arange(n) + 0.5
    return np.minimum(1.0, np.minimum(at, n - at) / (TILE_OVERLAP_PX / OUTPUT_STRIDE / 2)).astype(np.float32)


def class_map(probabilities: U8, size: tuple[int, int]) -> tuple[U8, U8]:
    """(H, W) index of the most probable class of every pixel, and (H, W) its probability (255 for 1).

    The index is `IGNORED` where labels without a class are more probable than all classes.

    Args:
        probabilities: (h, w, C) from `Classifier.probabilities`.
        size: (H, W) of the photo.
    """
    import cv2

    best, confidence = np.zeros(size, np.uint8), np.zeros(size, np.uint8)
    for k in range(probabilities.shape[2]):
        layer = cv2.resize(probabilities[..., k], size[::-1], interpolation=cv2.INTER_LINEAR)
        better = layer > confidence
        best[better], confidence[better] = k, layer[better]
    known = probabilities.sum(axis=2, dtype=np.float32)
    best[cv2.resize(known, size[::-1], interpolation=cv2.INTER_LINEAR) < 127] = IGNORED
    return best, confidence
