"""Photo prediction: renders what a photo should show from its neighbours. Import late: loads numba.

The depth map gives the surface point at every pixel of a photo; the other photos that see the point give its colour.
Where a photo differs from what the others agree on, something stood there that is no part of the street (a ghost), or
the pose of the photo is wrong.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from scan2sim.pipeline.camera.depth_map import DepthMap
from scan2sim.pipeline.camera.image_sampling import allows, mip_level, read
from scan2sim.pipeline.camera.models import EQUIRECTANGULAR, pixel_angle, pixel_rays
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
from scan2sim.pipeline.core.types import F32, F64, U8, Camera
from scan2sim.texturing.exposure_model import corrected, vignette
from scan2sim.texturing.photo_cache import SRGB_OFFSET, Photo

AGREEMENT_LEVELS = 28.0
"""Grey levels within which photos agree on a colour."""


@dataclass(frozen=True)
class Surface:
    """Surface points visible at a view's pixels.

    Attributes:
        camera: the view's camera, scaled to the size of the prediction.
        T_world_cam: (4, 4).
        points, normals: (H, W, 3) float32 in camera axes; points NaN where there is no surface.
    """

    camera: Camera
    T_world_cam: F64
    points: F32
    normals: F32

    def sample(self, count: int, max_distance: float, rng: np.random.Generator) -> tuple[F64, F64]:
        """At most `count` random points (N, 3) within `max_distance`, and their normals (N, 3); local coordinates."""
        near = np.einsum("hwk,hwk->hw", self.points, self.points) < max_distance**2
        at = np.flatnonzero(near.ravel())
        at = rng.choice(at, min(count, len(at)), replace=False) if len(at) else at
        R, centre = self.T_world_cam[:3, :3], self.T_world_cam[:3, 3]
        return self.points.reshape(-1, 3)[at] @ R.T + centre, self.normals.reshape(-1, 3)[at] @ R.T


@dataclass(frozen=True)
class Prediction:
    """A photo predicted from other photos.

    Attributes:
        rgb: (H, W, 3) float32, exposure corrected.
        support: (H, W) uint8, number of photos that agree on the colour.
        others: (H, W) uint8, number of photos that see the point.
    """

    rgb: F32
    support: U8
    others: U8


def surface(camera: Camera, depth: DepthMap) -> Surface:
    """Surface seen by a camera (the view's camera, scaled to the wanted size), from the view's depth map."""
    rays = pixel_rays(camera)
    rows = np.clip(np.round((np.arange(camera.height) + 0.5) * depth.camera.height / camera.height - 0.5), 0, None)
    columns = np.clip(np.round((np.arange(camera.width) + 0.5) * depth.camera.width / camera.width - 0.5), 0, None)
    ranges = depth.range[np.ix_(rows.astype(int), columns.astype(int))]
    points = rays * np.where(np.isfinite(ranges), ranges, np.nan).astype(np.float32)[..., None]
    return Surface(camera, depth.T_world_cam, points, _normals(points))


class Predictor:
    """Predicts a view from other photos of its surface.

    Args:
        surface: visible surface of the view.
        count: number of photos that will be added.
        max_distance, min_cos, bias: as in `ViewSelectionParams`.
    """

    def __init__(self, surface: Surface, count: int, *, max_distance: float, min_cos: float, bias: float) -> None:
        h, w = surface.points.shape[:2]
        self._surface = surface
        self._rgb = np.zeros((count, h, w, 3), np.uint8)
        self._weight = np.zeros((count, h, w), np.float32)
        self._limits = (max_distance, min_cos, bias)
        self._added = 0

    def add(self, photo: Photo, camera: Camera, T_world_cam: F64, depth: DepthMap, exposure: F64) -> None:
        """Sample the surface in one photo; `exposure` (5,) from `Exposures.of`."""
        s, (max_distance, min_cos, bias) = self._surface, self._limits
        _sample(
            self._rgb[self._added], self._weight[self._added], s.points, s.normals, pixel_angle(s.camera),
            photo.levels, photo.mask, posed_camera(camera, T_world_cam, s.T_world_cam), depth.ranges, exposure,
            max_distance, min_cos, bias,
        )  # fmt: skip
        self._added += 1

    def result(self) -> Prediction:
        """Colours on which the added photos agree."""
        h, w = self._weight.shape[1:]
        rgb = np.zeros((h, w, 3), np.float32)
        support, others = np.zeros((h, w), np.uint8), np.zeros((h, w), np.uint8)
        _agree(self._rgb[: self._added], self._weight[: self._added], rgb, support, others, AGREEMENT_LEVELS)
        return Prediction(rgb, support, others)


@njit(cache=True, parallel=True)
def _normals(points: F32) -> F32:
    """(H, W, 3) unit normals towards the camera, from each pixel's closer neighbours; along the ray at borders."""
    height, width = points.shape[:2]
    out = np.zeros((height, width, 3), np.float32)
    for v in prange(height):
        a, b = np.zeros(3), np.zeros(3)
        for u in range(width):
            p = points[v, u]
            r2 = p[0] * p[0] + p[1] * p[1] + p[2] * p[2]
            if not r2 > 0:
                continue
            least_a = least_b = 1e9
            for step in (-1, 1):
                if 0 <= u + step < width:
                    q = points[v, u + step]
                    d = (q[0] - p[0]) ** 2 + (q[1] - p[1]) ** 2 + (q[2] - p[2]) ** 2
                    if d < least_a:
                        least_a = d
                        for k in range(3):
                            a[k] = (q[k] - p[k]) * step
                if 0 <= v + step < height:
                    q = points[v + step, u]
                    d = (q[0] - p[0]) ** 2 + (q[1] - p[1]) ** 2 + (q[2] - p[2]) ** 2
                    if d < least_b:
                        least_b = d
                        for k in range(3):
                            b[k] = (q[k] - p[k]) * step
            nx, ny, nz = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
            n = math.sqrt(nx * nx + ny * ny + nz * nz)
            if least_a > 1e8 or least_b > 1e8 or n < 1e-12:
                r = math.sqrt(r2)
                out[v, u, 0], out[v, u, 1], out[v, u, 2] = -p[0] / r, -p[1] / r, -p[2] / r
                continue
            if nx * p[0] + ny * p[1] + nz * p[2] > 0:
                n = -n
            out[v, u, 0], out[v, u, 1], out[v, u, 2] = nx / n, ny / n, nz / n
    return out


@njit(cache=True, parallel=True)
def _sample(
    rgb: U8,
    weight: F32,
    points: F32,
    normals: F32,
    own_pixel: float,
    levels: tuple[U8, U8, U8],
    mask: U8,
    camera: PosedCamera,
    ranges: Ranges,
    exposure: F64,
    max_distance: float,
    min_cos: float,
    bias: float,
) -> None:
    height, width = weight.shape
    wide = camera.model == EQUIRECTANGULAR
    factors = (math.exp(exposure[0]), math.exp(exposure[1]), math.exp(exposure[2]))
    for row in prange(height):
        for column in range(width):
            a, n = points[row, column], normals[row, column]
            r2 = a[0] * a[0] + a[1] * a[1] + a[2] * a[2]
            if not 0.01 < r2 < max_distance * max_distance:
                continue
            x, y, z = to_camera(camera.T, a[0], a[1], a[2])
            d2 = x * x + y * y + z * z
            if not 0.01 < d2 < max_distance * max_distance:
                continue
            u, v, ok = pixel_of(camera, x, y, z)
            if not ok:
                continue
            nx, ny, nz = rotate_to_camera(camera.T, n[0], n[1], n[2])
            distance, cos = incidence(camera, x, y, z, nx, ny, nz)
            if cos < min_cos or not allows(mask, camera.p, u, v):
                continue
            if not is_visible(camera, ranges, u, v, distance, cos, bias):
                continue
            ratio = math.sqrt(r2) * own_pixel / (distance * camera.pixel)
            share = min(ratio, 1.0)
            level = mip_level(ratio, len(levels))
            r, g, b = read(levels[level], camera.p, u, v, wide)
            vignetting_factor = vignette(exposure, camera.p, u, v)
            rgb[row, column, 0] = min(255.0, max(0.0, corrected(r, factors[0] * vignetting_factor) + 0.5))
            rgb[row, column, 1] = min(255.0, max(0.0, corrected(g, factors[1] * vignetting_factor) + 0.5))
            rgb[row, column, 2] = min(255.0, max(0.0, corrected(b, factors[2] * vignetting_factor) + 0.5))
            weight[row, column] = cos * share * share + 1e-3


@njit(cache=True, parallel=True)
def _agree(rgb: U8, weight: F32, out: F32, support: U8, others: U8, tolerance: float) -> None:
    """Robust mean per pixel: of the samples within `tolerance` of the sample that most others agree with."""
    count, height, width = weight.shape
    for row in prange(height):
        for column in range(width):
            best, least, seen = -1, 1e30, 0
            for i in range(count):
                if weight[i, row, column] == 0:
                    continue
                seen += 1
                total = 0.0
                for j in range(count):
                    if j != i and weight[j, row, column] > 0:
                        difference = _colour_difference(rgb[i, row, column], rgb[j, row, column])
                        total += weight[j, row, column] * min(tolerance, difference)
                total -= weight[i, row, column] * tolerance  # of two samples that disagree, the better one
                if total < least:
                    best, least = i, total
            others[row, column] = seen
            if best < 0:
                continue
            w = 0.0
            for i in range(count):
                if weight[i, row, column] > 0:
                    d = _colour_difference(rgb[best, row, column], rgb[i, row, column])
                    if d < tolerance:
                        support[row, column] += 1
                        w += weight[i, row, column]
                        for k in range(3):
                            out[row, column, k] += weight[i, row, column] * rgb[i, row, column, k]
            for k in range(3):
                out[row, column, k] /= w


@njit(cache=True, inline="always")
def _colour_difference(a: npt.NDArray[Any], b: npt.NDArray[Any]) -> np.float32:
    """Mean absolute difference of two colours over the channels, grey levels."""
    return (
        abs(np.float32(a[0]) - np.float32(b[0]))
        + abs(np.float32(a[1]) - np.float32(b[1]))
        + abs(np.float32(a[2]) - np.float32(b[2]))
    ) / 3.0


def corrected_photo(photo: U8, camera: Camera, exposure: F64) -> F32:
    """Exposure corrected photo (H, W, 3) float32, unclipped; `camera` is scaled to the size of `photo` (H, W, 3)."""
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float32)
    cx, cy = (camera.width - 1) / 2, (camera.height - 1) / 2
    q = ((u - cx) ** 2 + (v - cy) ** 2) / (cx * cx + cy * cy)
    vignetting = exposure[3] * q + exposure[4] * q * q
    factor = np.exp(vignetting[..., None] + exposure[:3]).astype(np.float32)
    return (photo.astype(np.float32) + np.float32(SRGB_OFFSET)) * factor - np.float32(SRGB_OFFSET)
