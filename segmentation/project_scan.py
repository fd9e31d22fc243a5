"""Projection of a scan into photos, as channels for a network (`segmentation.lidar_channels`).

Every point is splatted as a square of the voxel's size with a depth test; gaps of single pixels are filled. Import
late: loads numba.
"""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np
from numba import njit

from scan2sim.pipeline.camera.models import EQUIRECTANGULAR, project_point
from scan2sim.pipeline.camera.projection import PosedCamera, posed_camera, to_camera
from scan2sim.pipeline.core.types import F32, I32, U8, Camera, PointCloud, View
from scan2sim.segmentation.lidar_channels import DOWNSAMPLING, MAX_DISTANCE_M, encode, ground_level

NORMAL_NEIGHBOURS = 12
"""Points to which a normal is fitted."""
FILL_MIN_NEIGHBOURS = 3
"""Neighbours (of eight) with points from which an empty pixel is filled."""


class ScanProjector:
    """Projects a scan into photos.

    Args:
        cloud: cloud with one point per voxel.
        size: voxel size in metres.
    """

    def __init__(self, cloud: PointCloud, size: float) -> None:
        self._xyz, self._size = cloud.xyz, size

    @cached_property
    def _codes(self) -> tuple[F32, F32]:
        """(N,) heights above the smoothed ground level, and |z| of the normals."""
        from scan2sim.pipeline.geometry.normals import normals
        from scan2sim.segmentation.geometric import split_ground

        ground = split_ground(self._xyz)[1]
        height = ground_level(self._xyz[ground] if ground.any() else self._xyz).above(self._xyz)
        return height, np.abs(normals(self._xyz, NORMAL_NEIGHBOURS)[:, 2])

    def channels(self, view: View, size: tuple[int, int]) -> U8:
        """(h, w, 4) channels of a photo that is classified at `size` (width, height)."""
        nearest, distance = self.nearest(view, size)
        height, up = self._codes
        return np.asarray(filled(encode(height[nearest], distance, up[nearest])), np.uint8)

    def nearest(self, view: View, size: tuple[int, int]) -> tuple[I32, F32]:
        """(h, w) visible point of each pixel, -1 for none, and its distance in metres, inf for none."""
        camera = channel_camera(view.camera, size)
        nearest = np.full((camera.height, camera.width), -1, np.int32)
        distance = np.full(nearest.shape, np.inf, np.float32)
        _splat(nearest, distance, self._xyz, posed_camera(camera, view.T_world_cam), self._size)
        return nearest, distance


def channel_camera(camera: Camera, size: tuple[int, int]) -> Camera:
    """The camera scaled to the channels of a photo that is classified at `size` (width, height)."""
    return camera.scaled(math.sqrt(size[0] * size[1] / (camera.width * camera.height)) / DOWNSAMPLING)


@njit(cache=True)
def _splat(nearest: I32, distance: F32, xyz: F32, camera: PosedCamera, size: float) -> None:
    """Splat points as squares of `size` metres with a depth test into `nearest` and `distance` (h, w), in place."""
    rows, columns = nearest.shape
    wide, half = camera.model == EQUIRECTANGULAR, 0.5 * size / camera.pixel
    for i in range(len(xyz)):
        x, y, z = to_camera(camera.T, xyz[i, 0], xyz[i, 1], xyz[i, 2])
        far = math.sqrt(x * x + y * y + z * z)
        if far < 0.5 or far > MAX_DISTANCE_M:
            continue
        u, v, ok = project_point(camera.model, camera.p, x, y, z)  # squares outside the image may extend into it
        if not ok:
            continue
        radius = half / far
        left, right = math.floor(u - radius + 0.5), math.floor(u + radius + 0.5)
        top, bottom = max(math.floor(v - radius + 0.5), 0), min(math.floor(v + radius + 0.5), rows - 1)
        for column in range(left, right + 1):
            k = column % columns if wide else column
            if k < 0 or k >= columns:
                continue
            for row in range(top, bottom + 1):
                if far < distance[row, k]:
                    distance[row, k], nearest[row, k] = far, i


@njit(cache=True)
def filled(codes: U8) -> U8:
    """(h, w, 4) codes with empty pixels between points filled with the codes of their nearest neighbour."""
    out = codes.copy()
    rows, columns = codes.shape[0], codes.shape[1]
    for r in range(1, rows - 1):
        for c in range(1, columns - 1):
            if codes[r, c, 3] == 0:
                count, best = 0, 256
                for i in range(r - 1, r + 2):
                    for j in range(c - 1, c + 2):
                        if codes[i, j, 3] > 0:
                            count += 1
                            if codes[i, j, 1] < best:
                                best = codes[i, j, 1]
                                out[r, c] = codes[i, j]
                if count < FILL_MIN_NEIGHBOURS:
                    out[r, c] = 0
    return out
