"""Synthetic scene: textured patches that move in front of a background, with camera shake."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.types import F32, U8
from scan2sim.services.toolboxes.results import Detection

RATE, SIZE = 25.0, (240, 400)


def texture(seed: int, height: int, width: int) -> F32:
    import cv2

    noise = np.random.default_rng(seed).normal(size=(height, width, 3)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return np.asarray(128 + smooth / smooth.std() * 40, np.float32)


def shown(image: F32, shift: tuple[float, float]) -> U8:
    import cv2

    moved = cv2.warpAffine(
        image, np.array([[1, 0, shift[0]], [0, 1, shift[1]]]), SIZE[::-1], borderMode=cv2.BORDER_REFLECT
    )
    return np.clip(moved, 0, 255).astype(np.uint8)


def detected(box: tuple[float, float, float, float], score: float = 0.9) -> Detection:
    return Detection(label="car", score=score, box=box)


class Scene:
    """Patches (left, top, width, height, speed in pixels/s, relative growth/s); later ones occlude earlier ones."""

    def __init__(self, *patches: tuple[float, float, int, int, float, float], shake: float = 0.0) -> None:
        self._patches, self._shake = patches, shake
        self._background = texture(0, *SIZE)
        self._rng = np.random.default_rng(1)

    def frame(self, seconds: float) -> tuple[U8, dict[int, Detection]]:
        import cv2

        image, boxes = self._background.copy(), dict[int, tuple[float, float, float, float]]()
        for i, (left, top, width, height, speed, growth) in enumerate(self._patches):
            scale, at = 1 + growth * seconds, left + speed * seconds
            patch = texture(10 + i, height, width)
            place = np.array([[scale, 0, at - width * (scale - 1) / 2], [0, scale, top - height * (scale - 1) / 2]])
            mask = cv2.warpAffine(np.ones((height, width), np.float32), place, SIZE[::-1])[..., None]
            image = cv2.warpAffine(patch, place, SIZE[::-1]) * mask + image * (1 - mask)
            x, y = place[:, 2]
            boxes[i] = (x, y, x + width * scale, y + height * scale)
        shift = tuple(self._rng.normal(scale=self._shake, size=2)) if self._shake else (0.0, 0.0)
        moved = {i: (a + shift[0], b + shift[1], c + shift[0], d + shift[1]) for i, (a, b, c, d) in boxes.items()}
        return shown(image, (shift[0], shift[1])), {i: detected(box) for i, box in moved.items()}
