"""Result of the view selection: candidate photos of every face, and the one that gives its detail."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.types import F32, I32


@dataclass(frozen=True)
class Choice:
    """View selection of all faces of a mesh.

    Attributes:
        view: (F, K) int32 candidate views, best first, -1 where fewer see the face.
        quality: (F, K) float32 quality of each candidate in 1/m2 (cos^2 / distance^2, where seen); 0 for none.
        detail_view: (F,) int32 view that gives the detail, -1 where none sees the face.
    """

    view: I32
    quality: F32
    detail_view: I32

    def save(self, path: Path) -> None:
        """Write as .npz."""
        np.savez(path, view=self.view, quality=self.quality, label=self.detail_view)

    @classmethod
    def load(cls, path: Path) -> Choice:
        """Read what `save` wrote."""
        with np.load(path) as data:
            return cls(data["view"], data["quality"], data["label"])
