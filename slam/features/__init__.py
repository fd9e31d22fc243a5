"""Feature detectors with descriptors.

Each backend is a module in this package, loaded by its name (`pipeline.core.plugins`). Backends process plain images:
`slam.trackers.descriptors` passes them the virtual views and converts pixels to bearings.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.types import F32, U8


class FeatureSet(NamedTuple):
    """Features of an image.

    Attributes:
        uv: (N, 2) float32 pixels.
        descriptors: (N, D) uint8 bits, or float32 of norm 1.
        scores: (N,) float32, larger is better.
    """

    uv: F32
    descriptors: npt.NDArray[Any]
    scores: F32


class Features(Protocol):
    """Interface of a detector.

    Attributes:
        name: name of the backend.
        binary: whether descriptors are bits.
        dimension: D of the descriptors: bytes if `binary`, else floats.
    """

    name: str
    binary: bool
    dimension: int

    def detect(self, image: U8, mask: U8 | None = None) -> FeatureSet:
        """The strongest `count` features of an image (H, W), none where `mask` (H, W) is 0."""

    def describe(self) -> str:
        """Description for logs, with hash and licence of the weights."""


class Backend(Protocol):
    """Interface of a backend's module."""

    def load(self, weights: Path | None, count: int, upsample: int, device: str) -> Features:
        """See `named`."""


def named(
    name: str, weights: Path | None = None, *, count: int = 3000, upsample: int = 1, device: str = "auto"
) -> Features:
    """Load the feature backend of a name.

    Args:
        name: name of the backend's module in this package.
        weights: the user's file or folder of weights, for networks.
        count: maximum number of features per image.
        upsample: factor by which images are enlarged before detection; 2 gives RootSIFT 10 % more matches in twice the
            time.
        device: torch device, for networks.

    Raises:
        SettingError: there is no such backend, or weights are missing, or given to a backend without any.
        UnavailableError: a package that it needs isn't installed.
        InputError: the weights are damaged, of another network, or unsafe to read.
    """
    backend: Backend = plugins.find(__name__, name, "track.features")
    return backend.load(weights, count, upsample, device)


def no_weights(name: str, weights: Path | None) -> None:
    """Raise SettingError if weights are given to a backend that has none."""
    if weights is not None:
        raise SettingError(
            "track.weights", f"{name!r} takes no weights", "Remove the weights, or choose a network for track.features"
        )


def enlarged(image: U8, mask: U8 | None, times: int) -> tuple[U8, U8 | None]:
    """Image and mask (H, W), enlarged by an integer factor."""
    import cv2

    if times == 1:
        return image, mask
    size = (image.shape[1] * times, image.shape[0] * times)
    large = cv2.resize(image, size, interpolation=cv2.INTER_LINEAR)
    return large, None if mask is None else cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST)


def unmasked(found: FeatureSet, mask: U8 | None) -> FeatureSet:
    """Features whose nearest pixel isn't masked; detectors apply the mask before subpixel refinement."""
    if mask is None or not len(found.uv):
        return found
    u, v = np.rint(found.uv).astype(int).T
    height, width = mask.shape
    keep = mask[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)] > 0
    return FeatureSet(*(values[keep] for values in found))


def reduced(uv: npt.ArrayLike, times: int) -> F32:
    """Pixels (N, 2) of an enlarged image in the original image."""
    return np.asarray((np.asarray(uv, np.float64).reshape(-1, 2) + 0.5) / times - 0.5, np.float32)
