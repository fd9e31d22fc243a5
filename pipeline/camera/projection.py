"""Projection of points into posed cameras: world to camera axes, camera axes to pixels, and the visibility test.

The kernels take scalars, one point at a time. Semantic voting, photo coverage, view selection, photo prediction, range
images and blending are built from them (image lookup: `pipeline.camera.image_sampling`). `pixels` works on arrays.
Import lazily: loads numba.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from scan2sim.pipeline.camera.image_sampling import nearest
from scan2sim.pipeline.camera.models import (
    EQUIRECTANGULAR,
    MODEL_ID,
    ORTHOGRAPHIC,
    parameters,
    pixel_angle,
    project_point,
)
from scan2sim.pipeline.core.types import F32, F64, Bools, Camera

SLOPE_BIAS_FACTOR = 0.4
"""Part of a pixel's depth change on a slope that is added to the bias; higher leaks more, lower occludes falsely."""
MAX_SLOPE = 30.0
"""tan(incidence) above which the bias doesn't grow any further (88 degrees)."""


class PosedCamera(NamedTuple):
    """A posed camera in the form that kernels take.

    Attributes:
        model, p: camera model and parameters (`models.MODEL_ID`, `models.parameters`).
        T: (4, 4) from the axes of the points to camera axes.
        pixel: angle of a pixel in radians (`models.pixel_angle`).
    """

    model: int
    p: F64
    T: F64
    pixel: float


class Ranges(NamedTuple):
    """A range image in the form that kernels take.

    Attributes:
        first: (H, W) float32 metres along the rays to the first hit; of any size, covering the whole image.
        pixel: angle of its pixels in radians.
    """

    first: F32
    pixel: float


def posed_camera(camera: Camera, T_world_cam: F64, axes: F64 | None = None) -> PosedCamera:
    """The camera with pose `T_world_cam` (4, 4), for kernels.

    Args:
        camera: intrinsics.
        T_world_cam: pose.
        axes: (4, 4) pose of the axes in which points will be given; None: local coordinates.
    """
    T = np.linalg.inv(np.asarray(T_world_cam, np.float64))
    T = np.ascontiguousarray(T if axes is None else T @ axes)
    return PosedCamera(MODEL_ID[camera.model], parameters(camera), T, pixel_angle(camera))


def pixels(camera: Camera, T_world_cam: F64, points: npt.ArrayLike) -> tuple[F32, Bools]:
    """Project points into a camera, regardless of occlusion.

    Args:
        camera, T_world_cam: intrinsics and pose.
        points: (N, 3) local metres.

    Returns:
        uv (N, 2) float32 pixels, and (N,) bool, True for pixels inside the image.
    """
    return _pixels(posed_camera(camera, T_world_cam), np.ascontiguousarray(points, np.float64).reshape(-1, 3))


@njit(cache=True, inline="always")
def to_camera(T: F64, x: float, y: float, z: float) -> tuple[float, float, float]:
    """(x, y, z): a point transformed by T (4, 4)."""
    return (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3],
    )


@njit(cache=True, inline="always")
def rotate_to_camera(T: F64, x: float, y: float, z: float) -> tuple[float, float, float]:
    """(x, y, z): a direction rotated by T (4, 4)."""
    return (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z,
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z,
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z,
    )


@njit(cache=True)
def pixel_of(camera: PosedCamera, x: float, y: float, z: float) -> tuple[float, float, bool]:
    """(u, v, ok): pixel of a point in camera axes; ok: inside the image, half-pixel border included."""
    u, v, ok = project_point(camera.model, camera.p, x, y, z)
    ok = ok and -0.5 <= v < camera.p[13] - 0.5
    return u, v, ok and (camera.model == EQUIRECTANGULAR or -0.5 <= u < camera.p[12] - 0.5)


@njit(cache=True, inline="always")
def incidence(
    camera: PosedCamera, x: float, y: float, z: float, nx: float, ny: float, nz: float
) -> tuple[float, float]:
    """(range, cos) of a point and its unit normal in camera axes: metres along the ray, and cosine of incidence.

    The cosine is positive if the camera is on the side of the normal.
    """
    if camera.model == ORTHOGRAPHIC:
        return z, -nz
    r = math.sqrt(x * x + y * y + z * z)
    return r, -(x * nx + y * ny + z * nz) / r


@njit(cache=True, inline="always")
def range_pixel(camera: PosedCamera, ranges: Any, u: float, v: float, r: float, cos: float) -> tuple[int, int, float]:
    """(row, column, lean): pixel of the range image that contains a point seen at (range, cos).

    `lean` is the change of range in metres across that pixel on a surface of that inclination.
    """
    row, column = nearest(camera.p, u, v, ranges.first)
    c = min(1.0, abs(cos))
    slope = min(MAX_SLOPE, math.sqrt(1 - c * c) / max(c, 1e-6))
    return row, column, slope * (ranges.pixel if camera.model == ORTHOGRAPHIC else r * ranges.pixel)


@njit(cache=True, inline="always")
def is_occluded(r: float, first: float, lean: float, pixels: float, bias: float) -> bool:
    """Whether a point is occluded by the `first` hit; the comparison used by all visibility tests.

    Args:
        r, lean: range of the point in metres, and `lean` from `range_pixel`.
        first: range of the first hit in metres, in the pixel of the range image, or the minimum over a neighbourhood.
        pixels: number of pixels over which the range may change by `lean` each.
        bias: tolerance behind `first` in metres, see `pipeline.camera.depth_map.RANGE_BIAS_M`.
    """
    return r > first + bias + pixels * lean


@njit(cache=True)
def is_visible(camera: PosedCamera, ranges: Ranges, u: float, v: float, r: float, cos: float, bias: float) -> bool:
    """Whether a point at a pixel inside the image is not occluded.

    Args:
        camera, ranges: camera and range image of the view.
        u, v: pixel of the point (`pixel_of`).
        r, cos: range and cosine of incidence (`incidence`); cos 1 assumes frontal incidence.
        bias: see `is_occluded`.
    """
    row, column, lean = range_pixel(camera, ranges, u, v, r, cos)
    return not is_occluded(r, ranges.first[row, column], lean, SLOPE_BIAS_FACTOR, bias)


@njit(cache=True, parallel=True)
def visible_points(camera: PosedCamera, ranges: Ranges, points: F64, normals: F64, bias: float) -> Bools:
    """(N,) bool: `is_visible` for points (N, 3) and normals (N, 3); (0, 3): assume frontal incidence."""
    seen = np.zeros(len(points), np.bool_)
    for i in prange(len(points)):
        x, y, z = to_camera(camera.T, points[i, 0], points[i, 1], points[i, 2])
        u, v, ok = pixel_of(camera, x, y, z)
        if not ok:
            continue
        nx = ny = nz = 0.0
        if len(normals) > 0:
            nx, ny, nz = rotate_to_camera(camera.T, normals[i, 0], normals[i, 1], normals[i, 2])
        r, cos = incidence(camera, x, y, z, nx, ny, nz)
        seen[i] = is_visible(camera, ranges, u, v, r, cos if len(normals) > 0 else 1.0, bias)
    return seen


@njit(cache=True, parallel=True)
def _pixels(camera: PosedCamera, points: F64) -> tuple[F32, Bools]:
    uv, ok = np.empty((len(points), 2), np.float32), np.empty(len(points), np.bool_)
    for i in prange(len(points)):
        x, y, z = to_camera(camera.T, points[i, 0], points[i, 1], points[i, 2])
        uv[i, 0], uv[i, 1], ok[i] = pixel_of(camera, x, y, z)
    return uv, ok
