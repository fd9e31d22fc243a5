"""RootSIFT: SIFT (Lowe 2004) by OpenCV, with the Hellinger kernel (Arandjelovic, Zisserman 2012). Needs no weights."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.types import U8
from scan2sim.slam.features import FeatureSet, enlarged, no_weights, reduced, unmasked

CONTRAST_MIN = 0.02
"""Contrast threshold; half of Lowe's, as walls and roads have little contrast."""


def load(weights: Path | None, count: int, upsample: int, device: str) -> RootSift:
    """See `slam.features.named`."""
    no_weights("rootsift", weights)
    return RootSift(count, upsample)


class RootSift:
    """See `slam.features.Features`."""

    name, binary, dimension = "rootsift", False, 128

    def __init__(self, count: int, upsample: int) -> None:
        self.count, self.upsample = count, upsample

    def detect(self, image: U8, mask: U8 | None = None) -> FeatureSet:
        """See `slam.features.Features`."""
        import cv2

        large, where = enlarged(image, mask, self.upsample)
        sift = cv2.SIFT_create(self.count, contrastThreshold=CONTRAST_MIN, enable_precise_upscale=True)
        points, histograms = sift.detectAndCompute(large, where)
        if histograms is None:
            return FeatureSet(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32), np.zeros(0, np.float32))
        uv = reduced([p.pt for p in points], self.upsample)
        # Euclidean distances of the roots are Hellinger distances of the histograms
        root = np.sqrt(histograms / np.maximum(np.abs(histograms).sum(axis=1, keepdims=True), 1e-9))
        scores = np.array([p.response for p in points], np.float32)
        return unmasked(FeatureSet(uv, np.asarray(root, np.float32), scores), mask)

    def describe(self) -> str:
        """See `slam.features.Features`."""
        return f"RootSIFT by OpenCV, images enlarged {self.upsample} times"
