"""RootSIFT: SIFT (Lowe 2004) by OpenCV, compared as histograms are (Arandjelovic, Zisserman 2012). Needs no weights."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.types import U8
from scan2sim.slam.features import Found, enlarged, no_weights, reduced, unmasked

CONTRAST = 0.02
"""Half of Lowe's: walls and roads have little."""


def load(weights: Path | None, count: int, upsample: int, device: str) -> RootSift:
    """See `slam.features.named`."""
    no_weights("rootsift", weights)
    return RootSift(count, upsample)


class RootSift:
    """See `slam.features.Features`."""

    name, binary, dimension = "rootsift", False, 128

    def __init__(self, count: int, upsample: int) -> None:
        self.count, self.upsample = count, upsample

    def detect(self, picture: U8, mask: U8 | None = None) -> Found:
        """See `slam.features.Features`."""
        import cv2

        large, where = enlarged(picture, mask, self.upsample)
        sift = cv2.SIFT_create(self.count, contrastThreshold=CONTRAST, enable_precise_upscale=True)
        points, found = sift.detectAndCompute(large, where)
        if found is None:
            return Found(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32), np.zeros(0, np.float32))
        uv = reduced([p.pt for p in points], self.upsample)
        # Euclidean distances of these are Hellinger distances of the histograms
        root = np.sqrt(found / np.maximum(np.abs(found).sum(axis=1, keepdims=True), 1e-9))
        scores = np.array([p.response for p in points], np.float32)
        return unmasked(Found(uv, np.asarray(root, np.float32), scores), mask)

    def describe(self) -> str:
        """See `slam.features.Features`."""
        return f"RootSIFT on pictures enlarged {self.upsample} times, by OpenCV"
