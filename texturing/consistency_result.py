"""Result of the photo consistency step: usable photos, their masks, warps and quality factors."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F32, U8, View
from scan2sim.pipeline.io.images import image


@dataclass(frozen=True)
class PhotoConsistency:
    """Result of the step `photo_consistency`, by index of view.

    Attributes:
        folder: contains `photo_consistency.json`, masks and warps.
        usable: whether the photo may be used for texture.
        quality_factors: factor on the photo's quality, below 1 if it is blurred.
    """

    folder: Path
    usable: tuple[bool, ...]
    quality_factors: tuple[float, ...]

    @classmethod
    def load(cls, folder: Path) -> PhotoConsistency:
        """Read the folder that the step wrote.

        Raises:
            InputError: `photo_consistency.json` is missing or damaged.
        """
        path = folder / "photo_consistency.json"
        try:
            rows = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, json.JSONDecodeError) as error:
            raise InputError(path, f"can't be read ({error})", "Run again with `--from photo_consistency`") from None
        return cls(folder, tuple(row["usable"] for row in rows), tuple(row["sharpness_factor"] for row in rows))

    def sharpness(self, i: int) -> float:
        """Factor on the quality of view `i`, below 1 if it is blurred."""
        return self.quality_factors[i]

    def mask(self, i: int, view: View) -> U8:
        """(h, w) uint8, 0 where photo `i` must not be used (its own mask, ghosts, sky); (0, 0): nothing is masked."""
        path = self.folder / f"mask_{i}.png"
        return image.read_levels(path) if path.is_file() else np.zeros((0, 0), np.uint8)

    def warp(self, i: int) -> F32:
        """(h, w, 2) float32 displacement in pixels, to be added to positions in photo `i`; (0, 0, 2): no warp."""
        path = self.folder / f"warp_{i}.npy"
        return np.load(path) if path.is_file() else np.zeros((0, 0, 2), np.float32)
