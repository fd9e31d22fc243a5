"""Camera models: projection of points to pixels, unprojection of pixels to rays, distortion.

Kernels take a camera as `MODEL_ID[camera.model]` and `parameters(camera)`.
Models and coefficient order are OpenCV's (calib3d and its fisheye module); see `pipeline.core.types.Camera`.
Import this module lazily: it loads numba.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from scan2sim.pipeline.core.types import F32, F64, Bools, Camera

PINHOLE, OPENCV, FISHEYE, EQUIRECTANGULAR, ORTHOGRAPHIC = range(5)
MODEL_ID: dict[str, int] = {
    "pinhole": PINHOLE,
    "opencv": OPENCV,
    "fisheye": FISHEYE,
    "equirectangular": EQUIRECTANGULAR,
    "orthographic": ORTHOGRAPHIC,
}
ORTHO_EQUIVALENT_FOCAL_PX = 1000.0
"""Focal length of the perspective camera with the same ground sample distance, for rating orthographic views."""
SERIAL_MAX = 10_000
"""Up to this number of points or pixels, a single thread is faster than starting several."""
# layout of the parameter array: fx fy cx cy, k1 k2 p1 p2 k3 k4 k5 k6, width height, limit of validity
_WIDTH, _HEIGHT, _LIMIT = 12, 13, 14


def parameters(camera: Camera) -> F64:
    """Parameters (15,) of a camera for kernels: focal lengths, principal point, distortion, size, limit of validity.

    Beyond the limit of validity, the distortion polynomial decreases and folds back on itself:
    tan(angle to the axis) for "opencv", the angle itself in radians for "fisheye".
    """
    p = np.zeros(15)
    p[:4] = camera.fx, camera.fy, camera.cx, camera.cy
    p[4 : 4 + len(camera.distortion)] = camera.distortion
    p[_WIDTH], p[_HEIGHT] = camera.width, camera.height
    p[_LIMIT] = _validity_limit(camera.model, tuple(camera.distortion))
    return p


@lru_cache(1024)
def _validity_limit(model: str, distortion: tuple[float, ...]) -> float:
    """See `parameters`; infinite if the distortion has no limit."""
    p = np.zeros(12)
    p[4 : 4 + len(distortion)] = distortion
    if model == "opencv":
        r = np.concatenate([np.linspace(0, 4, 4001), np.geomspace(4, 1e3, 1000)[1:]])
        r2 = r * r
        radial = r * (1 + r2 * (p[4] + r2 * (p[5] + r2 * p[8]))) / (1 + r2 * (p[9] + r2 * (p[10] + r2 * p[11])))
        return _first_fold(r, radial, np.inf)
    if model == "fisheye":
        theta = np.linspace(0, np.pi, 4001)
        t2 = theta * theta
        return _first_fold(theta, theta * (1 + t2 * (p[4] + t2 * (p[5] + t2 * (p[6] + t2 * p[7])))), np.pi)
    return np.inf


def _first_fold(x: F64, y: F64, no_fold: float) -> float:
    decreasing = np.flatnonzero(np.diff(y) <= 0)
    return float(x[decreasing[0]]) if len(decreasing) else no_fold


def project(camera: Camera, points_cam: npt.ArrayLike) -> tuple[F32, Bools]:
    """Project points given in camera coordinates.

    Args:
        camera: its intrinsics.
        points_cam: (N, 3) metres, camera axes.

    Returns:
        uv (N, 2) float32 pixels, and valid (N,) bool: in front of the camera and within the field of view
        where its distortion model is valid. Doesn't check whether a pixel lies inside the image (`inside` does).
    """
    uv, valid = project_exactly(camera, points_cam)
    return uv.astype(np.float32), valid


def project_exactly(camera: Camera, points_cam: npt.ArrayLike) -> tuple[F64, Bools]:
    """`project` in float64, for numerical derivatives."""
    points = np.ascontiguousarray(points_cam, np.float64).reshape(-1, 3)
    kernel = _project if len(points) > SERIAL_MAX else _project_serial
    return kernel(MODEL_ID[camera.model], parameters(camera), points)


def unproject(camera: Camera, uv: npt.ArrayLike) -> F64:
    """Unit rays (N, 3) in camera axes through pixels (N, 2); NaN for pixels outside the valid field of view."""
    pixels = np.ascontiguousarray(uv, np.float64).reshape(-1, 2)
    kernel = _unproject if len(pixels) > SERIAL_MAX else _unproject_serial
    return kernel(MODEL_ID[camera.model], parameters(camera), pixels)


def pixel_rays(camera: Camera) -> F32:
    """Unit rays (H, W, 3) in camera axes through the pixel centres; NaN outside the valid field of view.

    Photos of one camera share the array: don't change it.
    """
    return _shared_rays(MODEL_ID[camera.model], tuple(parameters(camera).tolist()), camera.height, camera.width)


@lru_cache(4)
def _shared_rays(model: int, p: tuple[float, ...], height: int, width: int) -> F32:
    return _pixel_rays(model, np.array(p), height, width)


def ray_origins(camera: Camera, uv: npt.ArrayLike) -> F64:
    """Origins (N, 3) of the rays through pixels (N, 2) in camera axes: 0 except for an orthographic camera."""
    uv = np.asarray(uv, np.float64).reshape(-1, 2)
    origins = np.zeros((len(uv), 3))
    if camera.model == "orthographic":
        origins[:, :2] = (uv - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    return origins


def inside(camera: Camera, uv: npt.NDArray[np.floating]) -> Bools:
    """(N,) whether pixels (N, 2) lie inside the image, half-pixel border included; panoramas wrap around."""
    u, v = uv[:, 0], uv[:, 1]
    across = (u >= -0.5) & (u < camera.width - 0.5) | (camera.model == "equirectangular")
    return across & (v >= -0.5) & (v < camera.height - 0.5)


def pixel_angle(camera: Camera) -> float:
    """Angle of a pixel at the image centre in radians; for an orthographic camera, its width in metres."""
    if camera.model == "equirectangular":
        return max(2 * math.pi / camera.width, math.pi / camera.height)
    return 1.0 / min(camera.fx, camera.fy)


@njit(cache=True, inline="always")
def _distort(p: F64, x: float, y: float) -> tuple[float, float]:
    """Brown-Conrady distortion of normalised image coordinates."""
    r2 = x * x + y * y
    radial = (1 + r2 * (p[4] + r2 * (p[5] + r2 * p[8]))) / (1 + r2 * (p[9] + r2 * (p[10] + r2 * p[11])))
    xd = x * radial + 2 * p[6] * x * y + p[7] * (r2 + 2 * x * x)
    yd = y * radial + p[6] * (r2 + 2 * y * y) + 2 * p[7] * x * y
    return xd, yd


@njit(cache=True, inline="always")
def _fisheye_radius(p: F64, theta: float) -> float:
    """Distorted radius of a ray at `theta` radians from the axis."""
    t2 = theta * theta
    return theta * (1 + t2 * (p[4] + t2 * (p[5] + t2 * (p[6] + t2 * p[7]))))


@njit(cache=True)
def project_point(model: int, p: F64, x: float, y: float, z: float) -> tuple[float, float, bool]:
    """(u, v, ok): pixel of a point in camera axes; the projection function of all kernels."""
    if model == EQUIRECTANGULAR:
        r = math.sqrt(x * x + y * y + z * z)
        if r < 1e-9:
            return 0.0, 0.0, False
        u = (math.atan2(x, z) / (2 * math.pi) + 0.5) * p[12] - 0.5
        v = (math.asin(min(1.0, max(-1.0, y / r))) / math.pi + 0.5) * p[13] - 0.5
        return u, v, True
    if model == FISHEYE:
        rxy = math.sqrt(x * x + y * y)
        theta = math.atan2(rxy, z)
        if theta >= p[14] or rxy + abs(z) < 1e-9:
            return 0.0, 0.0, False
        scale = _fisheye_radius(p, theta) / rxy if rxy > 1e-9 else 1.0 / z
        return p[0] * x * scale + p[2], p[1] * y * scale + p[3], True
    if z < 1e-6:
        return 0.0, 0.0, False
    if model == ORTHOGRAPHIC:
        return p[0] * x + p[2], p[1] * y + p[3], True
    x, y = x / z, y / z
    if model == OPENCV:
        if x * x + y * y >= p[14] * p[14]:
            return 0.0, 0.0, False
        x, y = _distort(p, x, y)
    return p[0] * x + p[2], p[1] * y + p[3], True


@njit(cache=True)
def unproject_pixel(model: int, p: F64, u: float, v: float) -> tuple[float, float, float]:
    """(x, y, z): unit ray through a pixel in camera axes; NaN outside the valid field of view."""
    if model == EQUIRECTANGULAR:
        lon = ((u + 0.5) / p[12] - 0.5) * 2 * math.pi
        lat = ((v + 0.5) / p[13] - 0.5) * math.pi
        return math.cos(lat) * math.sin(lon), math.sin(lat), math.cos(lat) * math.cos(lon)
    if model == ORTHOGRAPHIC:
        return 0.0, 0.0, 1.0
    xd, yd = (u - p[2]) / p[0], (v - p[3]) / p[1]
    if model == FISHEYE:
        radius = math.sqrt(xd * xd + yd * yd)
        if radius < 1e-12:
            return 0.0, 0.0, 1.0
        theta = _fisheye_angle(p, radius)
        s = math.sin(theta) / radius
        return xd * s, yd * s, math.cos(theta)
    x, y = xd, yd
    if model == OPENCV:
        x, y = _undistort(p, xd, yd)
    n = 1.0 / math.sqrt(x * x + y * y + 1)
    return x * n, y * n, n


@njit(cache=True)
def _fisheye_angle(p: F64, radius: float) -> float:
    """Inverse of `_fisheye_radius` by bisection on its monotonic part."""
    low, high = 0.0, p[14]
    if radius > _fisheye_radius(p, high):
        return math.nan
    for _ in range(48):
        middle = 0.5 * (low + high)
        if _fisheye_radius(p, middle) < radius:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


@njit(cache=True)
def _undistort(p: F64, xd: float, yd: float) -> tuple[float, float]:
    """Inverse of `_distort` by damped Newton steps with a numerical Jacobian, held within the valid field."""
    x, y = xd, yd
    r = math.sqrt(x * x + y * y)
    if r > 0.95 * p[14]:
        x, y = x * 0.95 * p[14] / r, y * 0.95 * p[14] / r
    h = 1e-6
    for _ in range(30):
        fx, fy = _distort(p, x, y)
        ex, ey = fx - xd, fy - yd
        if ex * ex + ey * ey < 1e-22:
            break
        ax, ay = _distort(p, x + h, y)
        bx, by = _distort(p, x, y + h)
        a, b, c, d = (ax - fx) / h, (bx - fx) / h, (ay - fy) / h, (by - fy) / h
        det = a * d - b * c
        if abs(det) < 1e-12:
            break
        x -= (d * ex - b * ey) / det
        y -= (a * ey - c * ex) / det
        r = math.sqrt(x * x + y * y)
        if r > p[14]:
            x, y = x * 0.999 * p[14] / r, y * 0.999 * p[14] / r
    fx, fy = _distort(p, x, y)
    if not (abs(fx - xd) + abs(fy - yd) < 1e-6):
        return math.nan, math.nan
    return x, y


@njit(cache=True, parallel=True)
def _project(model: int, p: F64, points: F64) -> tuple[F64, Bools]:
    uv = np.empty((len(points), 2))
    valid = np.empty(len(points), np.bool_)
    for i in prange(len(points)):
        u, v, ok = project_point(model, p, points[i, 0], points[i, 1], points[i, 2])
        uv[i, 0], uv[i, 1], valid[i] = u, v, ok
    return uv, valid


@njit(cache=True)
def _project_serial(model: int, p: F64, points: F64) -> tuple[F64, Bools]:
    uv = np.empty((len(points), 2))
    valid = np.empty(len(points), np.bool_)
    for i in range(len(points)):
        u, v, ok = project_point(model, p, points[i, 0], points[i, 1], points[i, 2])
        uv[i, 0], uv[i, 1], valid[i] = u, v, ok
    return uv, valid


@njit(cache=True, parallel=True)
def _unproject(model: int, p: F64, uv: F64) -> F64:
    rays = np.empty((len(uv), 3))
    for i in prange(len(uv)):
        rays[i, 0], rays[i, 1], rays[i, 2] = unproject_pixel(model, p, uv[i, 0], uv[i, 1])
    return rays


@njit(cache=True)
def _unproject_serial(model: int, p: F64, uv: F64) -> F64:
    rays = np.empty((len(uv), 3))
    for i in range(len(uv)):
        rays[i, 0], rays[i, 1], rays[i, 2] = unproject_pixel(model, p, uv[i, 0], uv[i, 1])
    return rays


@njit(cache=True, parallel=True)
def _pixel_rays(model: int, p: F64, height: int, width: int) -> F32:
    rays = np.empty((height, width, 3), np.float32)
    for v in prange(height):
        for u in range(width):
            rays[v, u, 0], rays[v, u, 1], rays[v, u, 2] = unproject_pixel(model, p, float(u), float(v))
    return rays
