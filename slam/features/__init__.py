"""Features: places in a picture that are found again in another, each with a descriptor.

A file a backend (`pipeline.core.plugins`), found by its name. Backends see pictures, never the sphere:
`slam.trackers.descriptors` shows them the facets and makes bearings of what they find.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.types import F32, U8


class Found(NamedTuple):
    """Features of a picture.

    Attributes:
        uv: (N, 2) float32 pixels.
        descriptors: (N, D) uint8 bits, or float32 of length 1.
        scores: (N,) float32, larger is better.
    """

    uv: F32
    descriptors: npt.NDArray[Any]
    scores: F32


class Features(Protocol):
    """A backend that is loaded.

    Attributes:
        name: of the backend.
        binary: whether descriptors are bits.
        dimension: D, of descriptors: bytes of bits, or numbers.
    """

    name: str
    binary: bool
    dimension: int

    def detect(self, picture: U8, mask: U8 | None = None) -> Found:
        """Features of a picture (H, W), none where `mask` (H, W) is 0; the strongest `count`."""

    def describe(self) -> str:
        """What this is, for logs: with the hash and licence of weights."""


class Backend(Protocol):
    """What a backend's module has."""

    def load(self, weights: Path | None, count: int, upsample: int, device: str) -> Features:
        """See `named`."""


def named(
    name: str, weights: Path | None = None, *, count: int = 3000, upsample: int = 1, device: str = "auto"
) -> Features:
    """A backend.

    Args:
        name: of its file here.
        weights: the user's file, for networks.
        count: features a picture at most.
        upsample: how many times pictures are enlarged before; 2 lets RootSIFT match a tenth more, in twice the time.
        device: of torch, for networks.

    Raises:
        SettingError: there is no such backend, or it wants weights, or none.
        UnavailableError: it can't run here.
        InputError: the weights are damaged, of another network, or unsafe to read.
    """
    backend: Backend = plugins.find(__name__, name, "track.features")
    return backend.load(weights, count, upsample, device)


def no_weights(name: str, weights: Path | None) -> None:
    """Raise SettingError if weights are given to a backend that has none."""
    if weights is not None:
        raise SettingError("track.weights", f"{name!r} takes no weights", "Leave them out, or choose a network")


def enlarged(picture: U8, mask: U8 | None, times: int) -> tuple[U8, U8 | None]:
    """Picture and mask, so many times as wide and high."""
    import cv2

    if times == 1:
        return picture, mask
    size = (picture.shape[1] * times, picture.shape[0] * times)
    large = cv2.resize(picture, size, interpolation=cv2.INTER_LINEAR)
    return large, None if mask is None else cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST)


def unmasked(found: Found, mask: U8 | None) -> Found:
    """Those whose nearest pixel isn't masked: detectors look at masks before they know places exactly."""
    if mask is None or not len(found.uv):
        return found
    u, v = np.rint(found.uv).astype(int).T
    height, width = mask.shape
    keep = mask[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)] > 0
    return Found(*(values[keep] for values in found))


def reduced(uv: npt.ArrayLike, times: int) -> F32:
    """Pixels (N, 2) of a picture before it was enlarged."""
    return np.asarray((np.asarray(uv, np.float64).reshape(-1, 2) + 0.5) / times - 0.5, np.float32)
