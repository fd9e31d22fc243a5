"""Exposure of each photo in training: gain and offset of each channel, held to those of the world."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.types import F32

MIN_GAIN, MAX_GAIN, MAX_OFFSET = 0.5, 2.0, 0.15
PRIOR, PRIOR_VARIANCE = 0.02, 0.05
"""Weight of a gain of 1, relative to the number of pixels, and the variance of colours that it counts as."""
DARK, BRIGHT = 0.02, 0.97
"""Levels of a photo outside of which pixels don't count: clipped."""
EVERY_PX = 3


class Gains:
    """Gain and offset of the photos.

    Attributes:
        gain, offset: (P, 3): a photo is gain * rendering + offset.
    """

    def __init__(self, count: int) -> None:
        self.gain, self.offset = np.ones((count, 3), np.float32), np.zeros((count, 3), np.float32)

    def solve(self, photo: int, rendered: F32, rgb: F32, weight: F32, rate: float) -> None:
        """Move a photo's towards the least-squares solution by `rate` (1: replace it)."""
        rendered, rgb = rendered[1::EVERY_PX, 1::EVERY_PX], rgb[1::EVERY_PX, 1::EVERY_PX]
        used = (weight[1::EVERY_PX, 1::EVERY_PX] > 0) & (rgb.max(axis=-1) < BRIGHT) & (rgb.max(axis=-1) > DARK)
        if not used.any():
            return
        x, y = rendered[used].astype(np.float64), rgb[used].astype(np.float64)
        mean_x, mean_y = x.mean(axis=0), y.mean(axis=0)
        prior = PRIOR * len(x) * PRIOR_VARIANCE
        gain = (((x - mean_x) * (y - mean_y)).sum(axis=0) + prior) / (((x - mean_x) ** 2).sum(axis=0) + prior)
        gain = np.clip(gain, MIN_GAIN, MAX_GAIN)
        offset = np.clip(mean_y - gain * mean_x, -MAX_OFFSET, MAX_OFFSET)
        self.gain[photo] += (rate * (gain - self.gain[photo])).astype(np.float32)
        self.offset[photo] += (rate * (offset - self.offset[photo])).astype(np.float32)

    def centre(self) -> tuple[F32, F32]:
        """Make the geometric mean of the gains 1 and the mean offset 0: the world has the exposure of the photos' mean.

        Returns:
            (3,) factor and offset by which the world's colours must change, so that all renderings stay as they are.
        """
        factor = np.exp(np.log(self.gain).mean(axis=0))
        gain = self.gain / factor
        shift = self.offset.mean(axis=0) / gain.mean(axis=0)
        self.gain, self.offset = gain, self.offset - gain * shift
        return factor, shift

    def applied(self, photo: int, rendered: F32) -> F32:
        """(H, W, 3) a rendering as the photo shows it."""
        return rendered * self.gain[photo] + self.offset[photo]
