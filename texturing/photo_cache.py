"""Photos read when needed and let go: their halvings, their low frequencies, masks, and corrected exposures."""

from __future__ import annotations

import json
import math
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64, U8, View
from scan2sim.pipeline.io.images import image

CACHE = 300_000_000
"""Bytes of photos kept in memory between uses."""
OFFSET = 255 * 0.055
"""sRGB is a power law of (value + this): a change of exposure is a factor there, all but exactly."""
GAMMA = 2.4


@dataclass(frozen=True)
class Exposures:
    """What makes photos alike: a factor of light per photo and channel, and one falling to the corners per camera.

    Attributes:
        gain: view's name to (3,) factors of linear light that its photo is multiplied with.
        vignetting: camera's name to (a, b): the photo is multiplied with exp(a q + b q^2) of light, where q is the
            squared distance from the image's middle, 1 in its corners.
    """

    gain: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    vignetting: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def of(self, view: View) -> F64:
        """(5,) for the kernels: logarithms of the encoded factors a channel, and a and b likewise."""
        gain, falling = self.gain.get(view.name, (1.0, 1.0, 1.0)), self.vignetting.get(camera_of(view), (0.0, 0.0))
        return np.array([*(math.log(g) for g in gain), *falling]) / GAMMA

    def save(self, path: Path) -> None:
        """Write as JSON."""
        body = {"gain": {k: list(v) for k, v in self.gain.items()}}
        path.write_text(
            json.dumps(body | {"vignetting": {k: list(v) for k, v in self.vignetting.items()}}, indent=1),
            encoding="utf-8",
        )

    @classmethod
    def load(cls, path: Path) -> Exposures:
        """Read what `save` wrote.

        Raises:
            InputError: it is no such file.
        """
        try:
            body = json.loads(path.read_text(encoding="utf-8"))
            gain = {str(k): (float(r), float(g), float(b)) for k, (r, g, b) in body["gain"].items()}
            falling = {str(k): (float(a), float(b)) for k, (a, b) in body["vignetting"].items()}
            if not all(math.isfinite(x) and x > 0 for v in gain.values() for x in v):
                raise ValueError("a gain is not above zero")
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise InputError(
                path, f"is no exposure file ({error})", "Give the `exposure.json` of another tile's run"
            ) from None
        return cls(gain, falling)


def camera_of(view: View) -> str:
    """A name that photos of one lens share, also across tiles: model, size and focal length."""
    c = view.camera
    return f"{c.model}_{c.width}x{c.height}_{c.fx:.0f}"


@dataclass(frozen=True)
class Photo:
    """A photo ready to be sampled.

    Attributes:
        levels: (h, w, 3) uint8: the photo, halved, and halved again.
        low: its low frequencies, at an eighth of its size or so.
        mask: (h, w) uint8, 0 where it must not be used; (0, 0) for none.
    """

    levels: tuple[U8, U8, U8]
    low: U8
    mask: U8

    @property
    def bytes(self) -> int:
        """What it takes in memory."""
        return sum(a.nbytes for a in (*self.levels, self.low, self.mask))


class Photos:
    """The photos of views, by index, the last used ones kept.

    Args:
        views: posed photos.
        band: pixels of a photo below which detail is taken from one photo alone; its low frequencies are coarser.

    Attributes:
        skipped: index of a view to the reason why its photo was left out.
    """

    def __init__(self, views: Sequence[View], band: int = 8) -> None:
        self._views, self._band = views, band
        self._kept: OrderedDict[int, Photo] = OrderedDict()
        self.skipped: dict[int, str] = {}

    def get(self, i: int) -> Photo | None:
        """Photo `i`; None if it can't be used (`skipped` tells why)."""
        if i in self._kept:
            self._kept.move_to_end(i)
            return self._kept[i]
        if i in self.skipped:
            return None
        photo = self._read(i)
        if photo is not None:
            self._kept[i] = photo
            while len(self._kept) > 1 and sum(p.bytes for p in self._kept.values()) > CACHE:
                self._kept.popitem(last=False)
        return photo

    def mask(self, i: int) -> U8 | None:
        """The mask of view `i` at its photo's size, (0, 0) for none; None if it can't be used."""
        view = self._views[i]
        try:
            mask = image.read_mask(view)
        except InputError as error:
            self.skipped[i] = f"{view.mask} {error.cause}"
            return None
        return np.zeros((0, 0), np.uint8) if mask is None else mask

    def _read(self, i: int) -> Photo | None:
        view = self._views[i]
        try:
            whole = image.read_photo(view)
        except InputError as error:
            self.skipped[i] = f"{view.photo} {error.cause}"
            return None
        mask = self.mask(i)
        if mask is None:
            return None
        half = shrunk(whole, 2)
        return Photo((whole, half, shrunk(half, 2)), low_frequencies(whole, self._band), mask)


def shrunk(image: U8, factor: int) -> U8:
    """The image at 1/factor of its size, means of its pixels."""
    import cv2

    size = (max(1, round(image.shape[1] / factor)), max(1, round(image.shape[0] / factor)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def low_frequencies(image: U8, band: int) -> U8:
    """The image without what is finer than about `band` pixels, at 1/band of its size."""
    import cv2

    return np.asarray(cv2.GaussianBlur(shrunk(image, band), (0, 0), 1.0), np.uint8)
