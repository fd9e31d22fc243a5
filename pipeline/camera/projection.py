"""Places projected into posed cameras, written once: into the camera's axes, into the image, and the visibility test.

Kernels take scalars, one place at a time; votes, reach, choice, prediction, range images and blending are put together
of them (how a picture is read at a pixel: `pipeline.camera.image_sampling`). `pixels` does it for arrays. Import late:
loads numba.
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

SLOPE_SHARE = 0.4
"""Of a pixel's footprint times the slope, what is added to the bias; more leaks, less hides falsely."""
MAX_SLOPE = 30.0
"""tan(incidence) beyond which the bias grows no more (88 degrees)."""


class Eye(NamedTuple):
    """A posed camera, as kernels take it.

    Attributes:
        model, p: of the camera (`cameras.MODEL_ID`, `cameras.parameters`).
        T: (4, 4) to camera axes from those that places are given in.
        pixel: radians that a pixel spans (`cameras.pixel_angle`).
    """

    model: int
    p: F64
    T: F64
    pixel: float


class Ranges(NamedTuple):
    """What an eye sees first, as kernels take it.

    Attributes:
        first: (H, W) float32 metres along the rays to the first hit; of any size, covering the eye's image.
        pixel: radians that its pixels span.
    """

    first: F32
    pixel: float


def eye(camera: Camera, T_world_cam: F64, axes: F64 | None = None) -> Eye:
    """The eye of a camera at `T_world_cam` (4, 4).

    Args:
        camera: its intrinsics.
        T_world_cam: its pose.
        axes: (4, 4) pose of the axes that places will be given in; None: local coordinates.
    """
    T = np.linalg.inv(np.asarray(T_world_cam, np.float64))
    T = np.ascontiguousarray(T if axes is None else T @ axes)
    return Eye(MODEL_ID[camera.model], parameters(camera), T, pixel_angle(camera))


def pixels(camera: Camera, T_world_cam: F64, places: npt.ArrayLike) -> tuple[F32, Bools]:
    """Where a camera shows places, whether or not something hides them.

    Args:
        camera, T_world_cam: intrinsics and pose.
        places: (N, 3) local metres.

    Returns:
        uv (N, 2) float32 pixels, and (N,) which of them are within the image.
    """
    return _pixels(eye(camera, T_world_cam), np.ascontiguousarray(places, np.float64).reshape(-1, 3))


@njit(cache=True, inline="always")
def to_camera(T: F64, x: float, y: float, z: float) -> tuple[float, float, float]:
    """(x, y, z) of a place in the axes that T (4, 4) leads to."""
    return (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3],
    )


@njit(cache=True, inline="always")
def turned(T: F64, x: float, y: float, z: float) -> tuple[float, float, float]:
    """(x, y, z) of a direction in the axes that T (4, 4) leads to."""
    return (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z,
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z,
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z,
    )


@njit(cache=True)
def pixel_of(eye: Eye, x: float, y: float, z: float) -> tuple[float, float, bool]:
    """(u, v, ok): the pixel of a place in camera axes; ok: it is within the image and its border of half a pixel."""
    u, v, ok = project_point(eye.model, eye.p, x, y, z)
    ok = ok and -0.5 <= v < eye.p[13] - 0.5
    return u, v, ok and (eye.model == EQUIRECTANGULAR or -0.5 <= u < eye.p[12] - 0.5)


@njit(cache=True, inline="always")
def incidence(eye: Eye, x: float, y: float, z: float, nx: float, ny: float, nz: float) -> tuple[float, float]:
    """(range, cos) of a place and its unit normal, camera axes: metres along the ray, and cosine of the incidence.

    The cosine is above 0 for what is seen from the side that the normal is on.
    """
    if eye.model == ORTHOGRAPHIC:
        return z, -nz
    r = math.sqrt(x * x + y * y + z * z)
    return r, -(x * nx + y * ny + z * nz) / r


@njit(cache=True, inline="always")
def range_pixel(eye: Eye, ranges: Any, u: float, v: float, r: float, cos: float) -> tuple[int, int, float]:
    """(row, column, lean): the pixel of the range image that a place seen at (range, cos) is in.

    And the metres by which the range changes across it, on a surface that is so inclined.
    """
    row, column = nearest(eye.p, u, v, ranges.first)
    c = min(1.0, abs(cos))
    slope = min(MAX_SLOPE, math.sqrt(1 - c * c) / max(c, 1e-6))
    return row, column, slope * (ranges.pixel if eye.model == ORTHOGRAPHIC else r * ranges.pixel)


@njit(cache=True, inline="always")
def is_behind(r: float, first: float, lean: float, pixels: float, bias: float) -> bool:
    """Whether a place is hidden by the `first` hit; every test of visibility is this one.

    Args:
        r, lean: metres along the ray to it, and of `range_pixel`.
        first: metres to the first hit, in the range image's pixel or in some pixels around.
        pixels: by which the surface may lean; from the middle of one, or as far around as `first` is the least of.
        bias: metres that it may lie behind `first`, see `pipeline.camera.depth_map.BIAS`.
    """
    return r > first + bias + pixels * lean


@njit(cache=True)
def is_visible(eye: Eye, ranges: Ranges, u: float, v: float, r: float, cos: float, bias: float) -> bool:
    """Whether nothing hides what is at a pixel within the image.

    Args:
        eye, ranges: of the view.
        u, v: `pixel_of` the place.
        r, cos: of it (`incidence`); cos 1: it is taken for seen head-on.
        bias: of `is_behind`.
    """
    row, column, lean = range_pixel(eye, ranges, u, v, r, cos)
    return not is_behind(r, ranges.first[row, column], lean, SLOPE_SHARE, bias)


@njit(cache=True, parallel=True)
def visible_places(eye: Eye, ranges: Ranges, places: F64, normals: F64, bias: float) -> Bools:
    """(N,) bool: `is_visible` for places (N, 3) and normals (N, 3), or (0, 3): all head-on."""
    seen = np.zeros(len(places), np.bool_)
    for i in prange(len(places)):
        x, y, z = to_camera(eye.T, places[i, 0], places[i, 1], places[i, 2])
        u, v, ok = pixel_of(eye, x, y, z)
        if not ok:
            continue
        nx = ny = nz = 0.0
        if len(normals) > 0:
            nx, ny, nz = turned(eye.T, normals[i, 0], normals[i, 1], normals[i, 2])
        r, cos = incidence(eye, x, y, z, nx, ny, nz)
        seen[i] = is_visible(eye, ranges, u, v, r, cos if len(normals) > 0 else 1.0, bias)
    return seen


@njit(cache=True, parallel=True)
def _pixels(eye: Eye, places: F64) -> tuple[F32, Bools]:
    uv, ok = np.empty((len(places), 2), np.float32), np.empty(len(places), np.bool_)
    for i in prange(len(places)):
        x, y, z = to_camera(eye.T, places[i, 0], places[i, 1], places[i, 2])
        uv[i, 0], uv[i, 1], ok[i] = pixel_of(eye, x, y, z)
    return uv, ok
