"""Facets: the pictures in which features of a frame are found and followed, and the way from pixels to the sphere.

A perspective or fisheye frame is its own facet. An equirectangular frame is three: the band around the horizon,
continued on both sides across the seam, and what two wide-angle cameras see that look straight up and straight down.
Within the band a turn of the car merely shifts the picture, within the caps it merely turns it: the seam and the poles
are no special places, and no feature is ever followed where the frame is stretched to more than 1.5 times its width.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.camera.models import pixel_rays, project, unproject
from scan2sim.pipeline.core.types import F32, F64, I32, I64, U8, Camera

BAND = math.radians(46)
"""Elevation up to which features are followed in the band."""
MARGIN = math.radians(8)
"""The facets overlap so far, so that a feature's surroundings are in its facet."""


class Facets:
    """Of a camera's frames.

    Attributes:
        camera: of the frames.
        count: of the facets.
        pixel: radians that a facet's pixel spans.
    """

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.whole = camera.model != "equirectangular"
        if self.whole:
            self.count, self.pixel = 1, 1.0 / camera.fx
            return
        w, h = camera.width, camera.height
        self.count, self.pixel = 3, 2 * math.pi / w
        self._pad = int(math.ceil(MARGIN / self.pixel))
        reach = (BAND + MARGIN) / math.pi * h
        self._rows = max(0, int(h / 2 - reach)), min(h, int(h / 2 + reach) + 1)
        half = math.tan(math.pi / 2 - BAND + MARGIN)
        focal = w / (2 * math.pi)
        size = int(math.ceil(2 * half * focal))
        middle = (size - 1) / 2
        self._cap = Camera("pinhole", size, size, focal, focal, middle, middle)
        rays = pixel_rays(self._cap).astype(np.float64)
        self._maps = []
        for axes in _CAPS:
            uv, _ = project(camera, (rays @ axes.T).reshape(-1, 3))
            x, y = uv.reshape(size, size, 2).transpose(2, 0, 1)
            self._maps.append((np.ascontiguousarray(x), np.clip(y, 0, h - 1)))  # beyond a pole isn't the other one

    def pictures(self, grey: U8) -> list[U8]:
        """The facets of a frame (H, W); of masks, too."""
        if self.whole:
            return [grey]
        import cv2

        band = cv2.copyMakeBorder(grey[self._rows[0] : self._rows[1]], 0, 0, self._pad, self._pad, cv2.BORDER_WRAP)
        caps = [cv2.remap(grey, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP) for maps in self._maps]
        return [band, *caps]

    def place(self, bearing: F64) -> I32:
        """(N,) the facet in which each of (N, 3) unit bearings is to be followed."""
        if self.whole:
            return np.zeros(len(bearing), np.int32)
        y = bearing[:, 1]
        return np.where(np.abs(y) <= math.sin(BAND), 0, np.where(y < 0, 1, 2)).astype(np.int32)

    def pixels(self, facet: int, bearing: F64) -> F32:
        """(N, 2) places in a facet of (N, 3) bearings; NaN where it doesn't show them."""
        if self.whole or facet == 0:
            uv, ok = project(self.camera, bearing)
            if not self.whole:
                uv[:, 0] += self._pad
                uv[:, 1] -= self._rows[0]
        else:
            uv, ok = project(self._cap, bearing @ _CAPS[facet - 1])
        uv[~ok] = np.nan
        return uv

    def bearings(self, facet: int, uv: npt.NDArray[np.floating]) -> F64:
        """(N, 3) unit bearings, camera axes, of places (N, 2) in a facet."""
        uv = np.asarray(uv, np.float64)
        if self.whole:
            return unproject(self.camera, uv)
        if facet == 0:
            return unproject(self.camera, uv + [-self._pad, self._rows[0]])
        return unproject(self._cap, uv) @ _CAPS[facet - 1].T

    def cell(self, bearing: F64, across: int) -> I64:
        """(N,) number of the cell of the sphere, or of the frame, that holds a bearing: `across` cells a full width."""
        if self.whole:
            uv, _ = project(self.camera, bearing)
            size = self.camera.width / across
            return (uv[:, 1] // size).astype(np.int64) * across + (uv[:, 0] // size).astype(np.int64)
        row = ((np.arcsin(np.clip(bearing[:, 1], -1, 1)) / math.pi + 0.5) * (across // 2)).astype(np.int64)
        middle = np.cos(((row + 0.5) / (across // 2) - 0.5) * math.pi)
        columns = np.maximum(1, np.round(across * middle))
        azimuth = np.arctan2(bearing[:, 0], bearing[:, 2]) / (2 * math.pi) + 0.5
        return row * across + np.minimum(azimuth * columns, columns - 1).astype(np.int64)


def _axes(x: Sequence[float], y: Sequence[float], z: Sequence[float]) -> F64:
    return np.array([x, y, z], np.float64).T


# cap camera's axes in the frame's: one looks up (-y), one down (+y)
_CAPS = (_axes([1, 0, 0], [0, 0, 1], [0, -1, 0]), _axes([1, 0, 0], [0, 0, -1], [0, 1, 0]))
