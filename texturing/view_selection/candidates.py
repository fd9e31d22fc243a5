"""Which photos texture a face: the best few of those that see it. Import late: it loads numba."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from scan2sim.pipeline.camera.depth_map import DepthMap
from scan2sim.pipeline.camera.models import ALIKE, ORTHOGRAPHIC
from scan2sim.pipeline.camera.projection import Eye, Ranges, eye, incidence, is_visible, pixel_of, to_camera, turned
from scan2sim.pipeline.core.types import F32, F64, I32, U8

DRAPED = 0.25
"""cos of the slope beyond which an orthophoto is no longer laid over a surface: of a facade it shows the edge alone."""
# where a face is looked at (barycentric): its middle, near its corners, near the middles of its edges
_SAMPLES = np.array(
    [[1 / 3, 1 / 3, 1 / 3], [0.9, 0.05, 0.05], [0.05, 0.9, 0.05], [0.05, 0.05, 0.9],
     [0.48, 0.48, 0.04], [0.04, 0.48, 0.48], [0.48, 0.04, 0.48]]
)  # fmt: skip


class Candidates:
    """The best views of every face, found view by view in bounded memory.

    Args:
        corners: (F, 3, 3) local metres.
        normals: (F, 3) unit.
        count: views kept for a face.

    Attributes:
        view: (F, count) int32 indices of views, best first, -1 where fewer see the face.
        quality: (F, count) float32 of each; 0 where there is none.
    """

    def __init__(self, corners: F32, normals: F32, count: int) -> None:
        self._corners, self._normals = corners, normals
        self.view = np.full((len(corners), count), -1, np.int32)
        self.quality = np.zeros((len(corners), count), np.float32)

    def offer(
        self, index: int, depth: DepthMap, *, bias: float, max_distance: float, min_cos: float,
        mask: U8 | None = None, factor: float = 1.0,
    ) -> int:  # fmt: skip
        """Let a view compete for every face; returns the number of faces that it sees.

        Args:
            index: of the view.
            depth: its depth map.
            bias: metres, of the visibility test.
            max_distance: metres, faces farther away are left to others.
            min_cos: of the angle between the face's normal and the ray; below it the face is left to others.
            mask: (H, W) of any size, 0 where the photo must not be used; None or (0, 0): nowhere.
            factor: on the view's quality, less than 1 for a blurred photo.
        """
        ranges = depth.ranges
        if mask is not None and mask.size:
            import cv2

            small = cv2.resize(mask, depth.range.shape[::-1], interpolation=cv2.INTER_NEAREST)
            ranges = ranges._replace(first=np.where(small > 0, depth.range, np.float32(-1e9)))  # nothing is seen there
        sees = eye(depth.camera, depth.T_world_cam)
        rated = _rate(self._corners, self._normals, sees, ranges, bias, max_distance, min_cos, _SAMPLES)
        rated *= np.float32(factor)
        _insert(rated, index, self.view, self.quality)
        return int((rated > 0).sum())


@njit(cache=True, parallel=True)
def _rate(
    corners: F32, normals: F32, eye: Eye, ranges: Ranges, bias: float, max_distance: float, min_cos: float, samples: F64
) -> F32:
    """(F,) float32: cos / distance^2 (1/m2), meaned over the face's samples, 0 for those not seen."""
    quality = np.zeros(len(corners), np.float32)
    for f in prange(len(corners)):
        nx, ny, nz = turned(eye.T, normals[f, 0], normals[f, 1], normals[f, 2])
        total = 0.0
        for s in range(len(samples)):
            wx = wy = wz = 0.0
            for k in range(3):
                wx += samples[s, k] * corners[f, k, 0]
                wy += samples[s, k] * corners[f, k, 1]
                wz += samples[s, k] * corners[f, k, 2]
            x, y, z = to_camera(eye.T, wx, wy, wz)
            r, cos = incidence(eye, x, y, z, nx, ny, nz)
            if eye.model == ORTHOGRAPHIC:  # how far away it is says nothing of how large its pixels are
                d2, flattest = (ALIKE / min(eye.p[0], eye.p[1])) ** 2, max(min_cos, DRAPED)
            else:
                d2, flattest = x * x + y * y + z * z, min_cos
                if d2 > max_distance * max_distance or d2 < 1e-6:
                    continue
            if cos < flattest:
                continue
            u, v, ok = pixel_of(eye, x, y, z)
            if ok and is_visible(eye, ranges, u, v, r, cos, bias):
                total += cos * cos / d2
        quality[f] = total / len(samples)
    return quality


@njit(cache=True, parallel=True)
def _insert(rated: F32, index: int, view: I32, quality: F32) -> None:
    """Insert a view into every face's list, kept in descending quality; ties stay with the earlier view."""
    count = view.shape[1]
    for f in prange(len(rated)):
        if rated[f] <= quality[f, count - 1]:
            continue
        k = count - 1
        while k > 0 and quality[f, k - 1] < rated[f]:
            quality[f, k], view[f, k] = quality[f, k - 1], view[f, k - 1]
            k -= 1
        quality[f, k], view[f, k] = rated[f], index
