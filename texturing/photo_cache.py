"""LRU cache of photos with their image pyramids, low frequencies and masks; exposure corrections."""

from __future__ import annotations

import json
import math
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F32, F64, U8, View
from scan2sim.pipeline.io.images import image
from scan2sim.texturing.consistency_result import PhotoConsistency

CACHE_MAX_BYTES = 300_000_000
"""Bytes of photos kept in memory between uses."""
SRGB_OFFSET = 255 * 0.055
"""sRGB is a power law of (value + offset): a change of exposure is almost exactly a factor of that sum."""
SRGB_GAMMA = 2.4
GREY_LEVEL_MIN, GREY_LEVEL_MAX = 12, 243
"""Grey levels outside of which a sample counts as under- or overexposed."""


@dataclass(frozen=True)
class Exposures:
    """Photometric corrections: a gain per photo and channel, and the vignetting of each camera.

    Attributes:
        gain: view name to (3,) factors by which the linear light of its photo is multiplied.
        vignetting: camera name to (a, b): linear light is multiplied by exp(a q + b q^2), where q is the squared
            distance from the image centre, 1 in the corners.
    """

    gain: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    vignetting: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def of(self, view: View) -> F64:
        """(5,) correction of a view for the kernels: log factors of the encoded values per channel, then a and b."""
        gain, vignetting = self.gain.get(view.name, (1.0, 1.0, 1.0)), self.vignetting.get(camera_of(view), (0.0, 0.0))
        return np.array([*(math.log(g) for g in gain), *vignetting]) / SRGB_GAMMA

    @property
    def white(self) -> float:
        """Corrected level of a surface just below overexposure in the photo with the largest gain; at least 255."""
        largest = max((g for gains in self.gain.values() for g in gains), default=1.0)
        return max(255.0, (GREY_LEVEL_MAX + SRGB_OFFSET) * largest ** (1 / SRGB_GAMMA) - SRGB_OFFSET)

    def save(self, path: Path) -> None:
        """Write as JSON."""
        factors = {"gain": self.gain, "vignetting": self.vignetting}
        body = {name: {k: list(v) for k, v in values.items()} for name, values in factors.items()}
        path.write_text(json.dumps(body, indent=1), encoding="utf-8")

    @classmethod
    def load(cls, path: Path) -> Exposures:
        """Read what `save` wrote.

        Raises:
            InputError: the file is missing or not an exposure file.
        """
        try:
            body = json.loads(path.read_text(encoding="utf-8"))
            gain = {str(k): (float(r), float(g), float(b)) for k, (r, g, b) in body["gain"].items()}
            vignetting = {str(k): (float(a), float(b)) for k, (a, b) in body["vignetting"].items()}
            if not all(math.isfinite(x) and x > 0 for v in gain.values() for x in v):
                raise ValueError("a gain is not a positive number")
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise InputError(
                path, f"not an exposure file ({error})", "Pass the `exposure.json` of another tile's run"
            ) from None
        return cls(gain, vignetting)


def squared_radius(height: int, width: int) -> F32:
    """(H, W) squared distance of the pixels from the image centre, 1 in the corners."""
    y, x = ((np.arange(n, dtype=np.float32) - (n - 1) / 2) for n in (height, width))
    return np.asarray(((x**2)[None, :] + (y**2)[:, None]) / float(x[0] ** 2 + y[0] ** 2), np.float32)


def camera_of(view: View) -> str:
    """Name of a view's camera, the same in all tiles, which refine its lens separately: folder and image size."""
    return f"{view.name.rpartition('/')[0]}_{view.camera.width}x{view.camera.height}"


@dataclass(frozen=True)
class Photo:
    """A photo prepared for sampling.

    Attributes:
        levels: image pyramid, (h, w, 3) uint8 each: full, half and quarter resolution.
        low: (h, w, 3) uint8 low frequencies, at 1/band of the full resolution.
        mask: (h, w) uint8, 0 where the photo must not be used; (0, 0): no mask.
    """

    levels: tuple[U8, U8, U8]
    low: U8
    mask: U8

    @property
    def bytes(self) -> int:
        """Memory size in bytes."""
        return sum(a.nbytes for a in (*self.levels, self.low, self.mask))


class PhotoCache:
    """Photos of views by index, read on demand; the least recently used ones are evicted.

    Args:
        views: posed photos.
        band: wavelength in pixels of a photo; `Photo.low` contains what is coarser.
        consistency: gives the masks; None: they are the photos' own.

    Attributes:
        skipped: index of a view to the reason why its photo can't be used.
    """

    def __init__(self, views: Sequence[View], band: int = 8, consistency: PhotoConsistency | None = None) -> None:
        self._views, self._band, self._consistency = views, band, consistency
        self._cached: OrderedDict[int, Photo] = OrderedDict()
        self.skipped: dict[int, str] = {}

    def get(self, i: int) -> Photo | None:
        """Photo `i`; None if it can't be used (the reason is in `skipped`)."""
        if i in self._cached:
            self._cached.move_to_end(i)
            return self._cached[i]
        if i in self.skipped:
            return None
        photo = self._read(i)
        if photo is not None:
            self._cached[i] = photo
            while len(self._cached) > 1 and sum(p.bytes for p in self._cached.values()) > CACHE_MAX_BYTES:
                self._cached.popitem(last=False)
        return photo

    def clear(self) -> None:
        """Free the memory of the photos."""
        self._cached.clear()

    def mask(self, i: int) -> U8 | None:
        """Mask of view `i` at its photo's size, (0, 0) if it has none; None if the mask can't be used."""
        view = self._views[i]
        try:
            mask = image.read_mask(view)
        except InputError as error:
            self.skipped[i] = f"{view.mask}: {error.cause}"
            return None
        return np.zeros((0, 0), np.uint8) if mask is None else mask

    def _read(self, i: int) -> Photo | None:
        view = self._views[i]
        try:
            full = image.read_photo(view)
        except InputError as error:
            self.skipped[i] = f"{view.photo}: {error.cause}"
            return None
        mask = self.mask(i) if self._consistency is None else self._consistency.mask(i, view)
        if mask is None:
            return None
        half = downsampled(full, 2)
        return Photo((full, half, downsampled(half, 2)), low_frequencies(full, self._band), mask)


def downsampled(image: U8, factor: int) -> U8:
    """The image at 1/factor of its size, by area averaging."""
    import cv2

    size = (max(1, round(image.shape[1] / factor)), max(1, round(image.shape[0] / factor)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def low_frequencies(image: U8, band: int) -> U8:
    """Low-pass filtered image without detail finer than about `band` pixels, at 1/band of its size."""
    import cv2

    return np.asarray(cv2.GaussianBlur(downsampled(image, band), (0, 0), 1.0), np.uint8)
