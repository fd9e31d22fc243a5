"""Photos predicted from those around them: what each should show. Import late: loads numba.

Through the depth map, every pixel of a photo is a place on the surface; the others that see that place give
its colour. Where a photo disagrees with what the others agree on, something stood there that is no part of the
street (a ghost), or its pose is off.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from scan2sim.pipeline.camera.depth_map import DepthMap
from scan2sim.pipeline.camera.image_sampling import allows, halving, read
from scan2sim.pipeline.camera.models import EQUIRECTANGULAR, pixel_angle, pixel_rays
from scan2sim.pipeline.camera.projection import Eye, Ranges, eye, incidence, is_visible, pixel_of, to_camera, turned
from scan2sim.pipeline.core.types import F32, F64, U8, Camera
from scan2sim.texturing.bake.blend_numba import corrected, vignette
from scan2sim.texturing.photo_cache import OFFSET, Photo

ALIKE = 28.0
"""Grey levels within which photos agree on a colour."""


@dataclass(frozen=True)
class Surface:
    """What a view's pixels show.

    Attributes:
        camera: the view's, scaled to the prediction's size.
        T_world_cam: (4, 4).
        points, normals: (H, W, 3) float32 in camera axes; points NaN where there is no surface.
    """

    camera: Camera
    T_world_cam: F64
    points: F32
    normals: F32

    def some(self, count: int, max_distance: float, rng: np.random.Generator) -> tuple[F64, F64]:
        """At most `count` random places (N, 3) nearer than that, and their normals (N, 3), local coordinates."""
        near = np.einsum("hwk,hwk->hw", self.points, self.points) < max_distance**2
        at = np.flatnonzero(near.ravel())
        at = rng.choice(at, min(count, len(at)), replace=False) if len(at) else at
        R, centre = self.T_world_cam[:3, :3], self.T_world_cam[:3, 3]
        return self.points.reshape(-1, 3)[at] @ R.T + centre, self.normals.reshape(-1, 3)[at] @ R.T


@dataclass(frozen=True)
class Prediction:
    """A photo as the others show it.

    Attributes:
        rgb: (H, W, 3) float32, corrected exposure.
        support: (H, W) uint8, photos that agree on it.
        others: (H, W) uint8, photos that see the place.
    """

    rgb: F32
    support: U8
    others: U8


def surface(camera: Camera, depth: DepthMap) -> Surface:
    """The surface that a camera (the view's, scaled to the size wanted) sees, from the view's depth map."""
    rays = pixel_rays(camera)
    rows = np.clip(np.round((np.arange(camera.height) + 0.5) * depth.camera.height / camera.height - 0.5), 0, None)
    columns = np.clip(np.round((np.arange(camera.width) + 0.5) * depth.camera.width / camera.width - 0.5), 0, None)
    ranges = depth.range[np.ix_(rows.astype(int), columns.astype(int))]
    points = rays * np.where(np.isfinite(ranges), ranges, np.nan).astype(np.float32)[..., None]
    return Surface(camera, depth.T_world_cam, points, _normals(points))


class Predictor:
    """Collects what other photos show of a surface.

    Args:
        surface: of the view that is predicted.
        count: photos that will be added.
        max_distance, min_cos, bias: as for texturing.
    """

    def __init__(self, surface: Surface, count: int, *, max_distance: float, min_cos: float, bias: float) -> None:
        h, w = surface.points.shape[:2]
        self._surface = surface
        self._rgb = np.zeros((count, h, w, 3), np.uint8)
        self._weight = np.zeros((count, h, w), np.float32)
        self._limits = (max_distance, min_cos, bias)
        self._added = 0

    def add(self, photo: Photo, camera: Camera, T_world_cam: F64, depth: DepthMap, exposure: F64) -> None:
        """Add what one photo shows; `exposure` (5,) of `Exposures.of`."""
        s, (max_distance, min_cos, bias) = self._surface, self._limits
        _sample(
            self._rgb[self._added], self._weight[self._added], s.points, s.normals, pixel_angle(s.camera),
            photo.levels, photo.mask, eye(camera, T_world_cam, s.T_world_cam), depth.ranges, exposure,
            max_distance, min_cos, bias,
        )  # fmt: skip
        self._added += 1

    def result(self) -> Prediction:
        """What those added agree on."""
        h, w = self._weight.shape[1:]
        rgb = np.zeros((h, w, 3), np.float32)
        support, others = np.zeros((h, w), np.uint8), np.zeros((h, w), np.uint8)
        _agree(self._rgb[: self._added], self._weight[: self._added], rgb, support, others, ALIKE)
        return Prediction(rgb, support, others)


@njit(cache=True, parallel=True)
def _normals(points: F32) -> F32:
    """(H, W, 3) unit normals towards the camera, from each pixel's nearer neighbours; along the ray at borders."""
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
    eye: Eye,
    ranges: Ranges,
    exposure: F64,
    max_distance: float,
    min_cos: float,
    bias: float,
) -> None:
    height, width = weight.shape
    wide = eye.model == EQUIRECTANGULAR
    factors = (math.exp(exposure[0]), math.exp(exposure[1]), math.exp(exposure[2]))
    for row in prange(height):
        for column in range(width):
            a, n = points[row, column], normals[row, column]
            r2 = a[0] * a[0] + a[1] * a[1] + a[2] * a[2]
            if not 0.01 < r2 < max_distance * max_distance:
                continue
            x, y, z = to_camera(eye.T, a[0], a[1], a[2])
            d2 = x * x + y * y + z * z
            if not 0.01 < d2 < max_distance * max_distance:
                continue
            u, v, ok = pixel_of(eye, x, y, z)
            if not ok:
                continue
            nx, ny, nz = turned(eye.T, n[0], n[1], n[2])
            distance, cos = incidence(eye, x, y, z, nx, ny, nz)
            if cos < min_cos or not allows(mask, eye.p, u, v):
                continue
            if not is_visible(eye, ranges, u, v, distance, cos, bias):
                continue
            ratio = math.sqrt(r2) * own_pixel / (distance * eye.pixel)
            share = min(ratio, 1.0)
            level = halving(ratio, len(levels))
            r, g, b = read(levels[level], eye.p, u, v, wide)
            fall = vignette(exposure, eye.p, u, v)
            rgb[row, column, 0] = min(255.0, max(0.0, corrected(r, factors[0] * fall) + 0.5))
            rgb[row, column, 1] = min(255.0, max(0.0, corrected(g, factors[1] * fall) + 0.5))
            rgb[row, column, 2] = min(255.0, max(0.0, corrected(b, factors[2] * fall) + 0.5))
            weight[row, column] = cos * share * share + 1e-3


@njit(cache=True, parallel=True)
def _agree(rgb: U8, weight: F32, out: F32, support: U8, others: U8, alike: float) -> None:
    """The mean of those that are alike the sample which most are alike to."""
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
                        total += weight[j, row, column] * min(alike, _apart(rgb[i, row, column], rgb[j, row, column]))
                total -= weight[i, row, column] * alike  # of two that are alone, the better
                if total < least:
                    best, least = i, total
            others[row, column] = seen
            if best < 0:
                continue
            w = 0.0
            for i in range(count):
                if weight[i, row, column] > 0:
                    d = _apart(rgb[best, row, column], rgb[i, row, column])
                    if d < alike:
                        support[row, column] += 1
                        w += weight[i, row, column]
                        for k in range(3):
                            out[row, column, k] += weight[i, row, column] * rgb[i, row, column, k]
            for k in range(3):
                out[row, column, k] /= w


@njit(cache=True, inline="always")
def _apart(a: npt.NDArray[Any], b: npt.NDArray[Any]) -> np.float32:
    """How far two colours are apart: the mean over channels, grey levels."""
    return (
        abs(np.float32(a[0]) - np.float32(b[0]))
        + abs(np.float32(a[1]) - np.float32(b[1]))
        + abs(np.float32(a[2]) - np.float32(b[2]))
    ) / 3.0


def corrected_photo(photo: U8, camera: Camera, exposure: F64) -> F32:
    """The photo (H, W, 3), of a camera scaled to it, with its exposure corrected; (H, W, 3) float32, unclipped."""
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float32)
    cx, cy = (camera.width - 1) / 2, (camera.height - 1) / 2
    q = ((u - cx) ** 2 + (v - cy) ** 2) / (cx * cx + cy * cy)
    fall = exposure[3] * q + exposure[4] * q * q
    factor = np.exp(fall[..., None] + exposure[:3]).astype(np.float32)
    return (photo.astype(np.float32) + np.float32(OFFSET)) * factor - np.float32(OFFSET)
