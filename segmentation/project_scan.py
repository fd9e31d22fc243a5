"""A scan, drawn into photos as channels for a network (`segmentation.lidar_channels`). Import late: loads numba.

It is drawn point by point, as squares of a voxel's size, the nearest before the others; gaps of a pixel are closed.
"""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np
from numba import njit

from scan2sim.pipeline.camera.models import EQUIRECTANGULAR, project_point
from scan2sim.pipeline.camera.projection import Eye, eye, to_camera
from scan2sim.pipeline.core.types import F32, I32, U8, Camera, PointCloud, View
from scan2sim.segmentation.lidar_channels import FAR, FRACTION, coded, level

NEIGHBOURS = 12
"""Points that a normal is fitted to."""
GAP = 3
"""Neighbours, of eight, that a pixel without points is filled from."""


class Drawn:
    """A scan, drawn into photos.

    Args:
        cloud: thinned to a point a voxel.
        size: metres of the voxels.
    """

    def __init__(self, cloud: PointCloud, size: float) -> None:
        self._xyz, self._size = cloud.xyz, size

    @cached_property
    def _codes(self) -> tuple[F32, F32]:
        """(N,) heights above the ground's level, and upward parts of the normals."""
        from scan2sim.pipeline.geometry.normals import normals
        from scan2sim.segmentation.geometric import split_ground

        ground = split_ground(self._xyz)[1]
        height = level(self._xyz[ground] if ground.any() else self._xyz).above(self._xyz)
        return height, np.abs(normals(self._xyz, NEIGHBOURS)[:, 2])

    def into(self, view: View, size: tuple[int, int]) -> U8:
        """(h, w, 4) of a photo that is looked at in `size` (width, height)."""
        nearest, distance = self.nearest(view, size)
        height, up = self._codes
        return np.asarray(filled(coded(height[nearest], distance, up[nearest])), np.uint8)

    def nearest(self, view: View, size: tuple[int, int]) -> tuple[I32, F32]:
        """(h, w) which point each pixel shows, -1 for none, and metres to it, inf for none; `size` as of `into`."""
        camera = resized(view.camera, size)
        nearest = np.full((camera.height, camera.width), -1, np.int32)
        distance = np.full(nearest.shape, np.inf, np.float32)
        _draw(nearest, distance, self._xyz, eye(camera, view.T_world_cam), self._size)
        return nearest, distance


def resized(camera: Camera, size: tuple[int, int]) -> Camera:
    """The camera of the channels' picture."""
    return camera.scaled(math.sqrt(size[0] * size[1] / (camera.width * camera.height)) / FRACTION)


@njit(cache=True)
def _draw(nearest: I32, distance: F32, xyz: F32, eye: Eye, size: float) -> None:
    """Which point each pixel shows: the nearest of the squares over it, whose sides are `size` metres."""
    rows, columns = nearest.shape
    wide, half = eye.model == EQUIRECTANGULAR, 0.5 * size / eye.pixel
    for i in range(len(xyz)):
        x, y, z = to_camera(eye.T, xyz[i, 0], xyz[i, 1], xyz[i, 2])
        far = math.sqrt(x * x + y * y + z * z)
        if far < 0.5 or far > FAR:
            continue
        u, v, ok = project_point(eye.model, eye.p, x, y, z)  # squares may reach into the image from beside it
        if not ok:
            continue
        reach = half / far
        left, right = math.floor(u - reach + 0.5), math.floor(u + reach + 0.5)
        top, bottom = max(math.floor(v - reach + 0.5), 0), min(math.floor(v + reach + 0.5), rows - 1)
        for column in range(left, right + 1):
            k = column % columns if wide else column
            if k < 0 or k >= columns:
                continue
            for row in range(top, bottom + 1):
                if far < distance[row, k]:
                    distance[row, k], nearest[row, k] = far, i


@njit(cache=True)
def filled(codes: U8) -> U8:
    """(h, w, 4): pixels where nothing is, with some around them, take their nearest neighbour's codes."""
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
                if count < GAP:
                    out[r, c] = 0
    return out
