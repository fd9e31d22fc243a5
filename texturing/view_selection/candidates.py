"""Candidate views of each face: the best few of the photos that see it. Import late: it loads numba."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from scan2sim.pipeline.camera.depth_map import DepthMap
from scan2sim.pipeline.camera.models import ORTHO_EQUIVALENT_FOCAL_PX, ORTHOGRAPHIC
from scan2sim.pipeline.camera.projection import (
    PosedCamera,
    Ranges,
    incidence,
    is_visible,
    pixel_of,
    posed_camera,
    rotate_to_camera,
    to_camera,
)
from scan2sim.pipeline.core.types import F32, F64, I32, U8

ORTHOPHOTO_MIN_COS = 0.25
"""Cosine of the slope below which an orthophoto is not used for a surface: of a facade it shows only the edge."""
# barycentric points at which a face's visibility is sampled: centre, near the corners, near the middles of the edges
_SAMPLES = np.array(
    [[1 / 3, 1 / 3, 1 / 3], [0.9, 0.05, 0.05], [0.05, 0.9, 0.05], [0.05, 0.05, 0.9],
     [0.48, 0.48, 0.04], [0.04, 0.48, 0.48], [0.48, 0.04, 0.48]]
)  # fmt: skip


class Candidates:
    """Best views of every face, updated one view at a time in bounded memory.

    Args:
        corners: (F, 3, 3) corners of the faces, local metres.
        normals: (F, 3) unit normals of the faces.
        count: number of views kept per face.

    Attributes:
        view: (F, count) int32 indices of views, best first, -1 where fewer views see the face.
        quality: (F, count) float32 quality of each view; 0 where there is none.
    """

    def __init__(self, corners: F32, normals: F32, count: int) -> None:
        self._corners, self._normals = corners, normals
        self.view = np.full((len(corners), count), -1, np.int32)
        self.quality = np.zeros((len(corners), count), np.float32)

    def add_view(
        self, index: int, depth: DepthMap, *, bias: float, max_distance: float, min_cos: float,
        mask: U8 | None = None, factor: float = 1.0,
    ) -> int:  # fmt: skip
        """Rate a view for every face and keep it where it is among the best; returns the number of faces it sees.

        Args:
            index: index of the view.
            depth: depth map of the view.
            bias: tolerance of the visibility test in metres.
            max_distance: metres beyond which the view is not used for a face.
            min_cos: cosine of the angle between the face's normal and the ray below which the view is not used.
            mask: (H, W) of any size, 0 where the photo must not be used; None or (0, 0): nothing is masked.
            factor: factor on the view's quality, below 1 for a blurred photo.
        """
        ranges = depth.ranges
        if mask is not None and mask.size:
            import cv2

            small = cv2.resize(mask, depth.range.shape[::-1], interpolation=cv2.INTER_NEAREST)
            ranges = ranges._replace(first=np.where(small > 0, depth.range, np.float32(-1e9)))  # hides all surfaces
        camera = posed_camera(depth.camera, depth.T_world_cam)
        rated = _rate(self._corners, self._normals, camera, ranges, bias, max_distance, min_cos, _SAMPLES)
        rated *= np.float32(factor)
        _insert(rated, index, self.view, self.quality)
        return int((rated > 0).sum())


@njit(cache=True, parallel=True)
def _rate(
    corners: F32,
    normals: F32,
    camera: PosedCamera,
    ranges: Ranges,
    bias: float,
    max_distance: float,
    min_cos: float,
    samples: F64,
) -> F32:
    """(F,) float32 quality: cos^2 / distance^2 (1/m2), averaged over the face's samples, 0 for hidden samples."""
    quality = np.zeros(len(corners), np.float32)
    for f in prange(len(corners)):
        nx, ny, nz = rotate_to_camera(camera.T, normals[f, 0], normals[f, 1], normals[f, 2])
        total = 0.0
        for s in range(len(samples)):
            wx = wy = wz = 0.0
            for k in range(3):
                wx += samples[s, k] * corners[f, k, 0]
                wy += samples[s, k] * corners[f, k, 1]
                wz += samples[s, k] * corners[f, k, 2]
            x, y, z = to_camera(camera.T, wx, wy, wz)
            r, cos = incidence(camera, x, y, z, nx, ny, nz)
            if camera.model == ORTHOGRAPHIC:  # the ground sample distance doesn't depend on the distance
                d2, flattest = (
                    (ORTHO_EQUIVALENT_FOCAL_PX / min(camera.p[0], camera.p[1])) ** 2,
                    max(min_cos, ORTHOPHOTO_MIN_COS),
                )
            else:
                d2, flattest = x * x + y * y + z * z, min_cos
                if d2 > max_distance * max_distance or d2 < 1e-6:
                    continue
            if cos < flattest:
                continue
            u, v, ok = pixel_of(camera, x, y, z)
            if ok and is_visible(camera, ranges, u, v, r, cos, bias):
                total += cos * cos / d2
        quality[f] = total / len(samples)
    return quality


@njit(cache=True, parallel=True)
def _insert(rated: F32, index: int, view: I32, quality: F32) -> None:
    """Insert a view into every face's list, sorted by descending quality; in ties the earlier view comes first."""
    count = view.shape[1]
    for f in prange(len(rated)):
        if rated[f] <= quality[f, count - 1]:
            continue
        k = count - 1
        while k > 0 and quality[f, k - 1] < rated[f]:
            quality[f, k], view[f, k] = quality[f, k - 1], view[f, k - 1]
            k -= 1
        quality[f, k], view[f, k] = rated[f], index
