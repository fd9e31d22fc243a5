"""Virtual views: the images in which a frame's features are detected and tracked, and their mapping to bearings.

A perspective or fisheye frame is its own view. An equirectangular frame becomes three: the band around the horizon,
wrapped on both sides across the seam, and two virtual wide-angle pinhole cameras that look straight up and straight
down (the caps). When the car turns, the band's image only shifts and the caps' images only rotate. The seam and the
poles need no special treatment, and features are tracked only where the frame is stretched to at most 1.5 times its
width.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.camera.models import pixel_rays, project, unproject
from scan2sim.pipeline.core.types import F32, F64, I32, I64, U8, Camera

BAND_ELEVATION = math.radians(46)
"""Elevation up to which features are tracked in the band, radians."""
OVERLAP = math.radians(8)
"""Overlap of the views, radians, so that a feature's surroundings are in its view."""


class VirtualViews:
    """Virtual views of a camera's frames.

    Attributes:
        camera: camera of the frames.
        single: whether the frame itself is the only view.
        count: number of views.
        pixel: angle that a view's pixel spans, radians.
    """

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.single = camera.model != "equirectangular"
        if self.single:
            self.count, self.pixel = 1, 1.0 / camera.fx
            return
        w, h = camera.width, camera.height
        self.count, self.pixel = 3, 2 * math.pi / w
        self._pad = int(math.ceil(OVERLAP / self.pixel))
        half_rows = (BAND_ELEVATION + OVERLAP) / math.pi * h
        self._rows = max(0, int(h / 2 - half_rows)), min(h, int(h / 2 + half_rows) + 1)
        half = math.tan(math.pi / 2 - BAND_ELEVATION + OVERLAP)
        focal = w / (2 * math.pi)
        size = int(math.ceil(2 * half * focal))
        centre = (size - 1) / 2
        self._cap = Camera("pinhole", size, size, focal, focal, centre, centre)
        rays = pixel_rays(self._cap).astype(np.float64)
        self._maps = []
        for axes in _CAPS:
            uv, _ = project(camera, (rays @ axes.T).reshape(-1, 3))
            x, y = uv.reshape(size, size, 2).transpose(2, 0, 1)
            self._maps.append((np.ascontiguousarray(x), np.clip(y, 0, h - 1)))  # rows must not wrap around at a pole

    def images(self, grey: U8) -> list[U8]:
        """Virtual views of a frame or mask (H, W)."""
        if self.single:
            return [grey]
        import cv2

        band = cv2.copyMakeBorder(grey[self._rows[0] : self._rows[1]], 0, 0, self._pad, self._pad, cv2.BORDER_WRAP)
        caps = [cv2.remap(grey, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP) for maps in self._maps]
        return [band, *caps]

    def view_of(self, bearing: F64) -> I32:
        """(N,) index of the view in which features with unit bearings (N, 3) are tracked."""
        if self.single:
            return np.zeros(len(bearing), np.int32)
        y = bearing[:, 1]
        return np.where(np.abs(y) <= math.sin(BAND_ELEVATION), 0, np.where(y < 0, 1, 2)).astype(np.int32)

    def pixels(self, view: int, bearing: F64) -> F32:
        """(N, 2) pixels of bearings (N, 3) in a view; NaN where they aren't visible in it."""
        if self.single or view == 0:
            uv, ok = project(self.camera, bearing)
            if not self.single:
                uv[:, 0] += self._pad
                uv[:, 1] -= self._rows[0]
        else:
            uv, ok = project(self._cap, bearing @ _CAPS[view - 1])
        uv[~ok] = np.nan
        return uv

    def bearings(self, view: int, uv: npt.NDArray[np.floating]) -> F64:
        """(N, 3) unit bearings, camera axes, of pixels (N, 2) in a view."""
        uv = np.asarray(uv, np.float64)
        if self.single:
            return unproject(self.camera, uv)
        if view == 0:
            return unproject(self.camera, uv + [-self._pad, self._rows[0]])
        return unproject(self._cap, uv) @ _CAPS[view - 1].T

    def cell(self, bearing: F64, across: int) -> I64:
        """(N,) index of the grid cell of each bearing, on the sphere or in the frame: `across` cells per full width."""
        if self.single:
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


# axes of the cap cameras in the frame's camera: one looks up (-y), one down (+y)
_CAPS = (_axes([1, 0, 0], [0, 0, 1], [0, -1, 0]), _axes([1, 0, 0], [0, 0, -1], [0, 1, 0]))
