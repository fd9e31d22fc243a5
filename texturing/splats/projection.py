"""Projection of splats into a pinhole image, and its gradient (EWA splatting, Zwicker et al., 2001)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit, prange

from scan2sim.pipeline.core.types import F32, F64, I32, Bools, Camera
from scan2sim.texturing.splats.blending import MIN_ALPHA

U, V, CONIC_A, CONIC_B, CONIC_C, OPACITY, EXTENT_X, EXTENT_Y, DEPTH, SLOPE_X, SLOPE_Y = range(11)
"""Columns of projected splats: centre in pixels; inverse covariance [[A, B], [B, C]]; opacity; half width and height
in pixels beyond which it is invisible; depth of the centre along the optical axis; change of the inverse depth per
pixel, which is constant over a plane."""
PROJECTED = 11
LOW_PASS = 0.3
"""Variance in square pixels that is added to the projected covariance, as all viewers do."""
FIELD_MARGIN = 1.3
"""The projection is linearized at most at this multiple of the field of view: beyond it shapes explode."""
MIN_SLOPE_COS = 0.01
"""Cosine of the angle between the normal of a flat splat and the ray through its centre around which the slope of its
inverse depth is reduced: splats that are seen from their edge have hardly a plane."""
NEAR_M = 0.2
"""Splats nearer to the camera aren't drawn."""
FASTMATH = {"reassoc", "contract", "nsz", "arcp", "afn"}
"""Without "nnan" and "ninf": splats whose projection isn't finite are left out."""
GRADIENT = 10
"""Image gradients of a splat: red, green, blue, inverse depth, opacity, U, V, CONIC_A, CONIC_B, CONIC_C."""


class Pinhole(NamedTuple):
    """A pinhole camera for the kernels.

    Attributes:
        rotation, translation: (3, 3) and (3,), from world to camera axes, metres.
        intrinsics: (4,) fx, fy, cx, cy in pixels.
        width, height: pixels.
    """

    rotation: F32
    translation: F32
    intrinsics: F32
    width: int
    height: int

    @classmethod
    def of(cls, camera: Camera, T_world_cam: F64) -> Pinhole:
        """The camera of a view; its model is "pinhole"."""
        inverse = np.linalg.inv(T_world_cam).astype(np.float32)
        intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
        rotation, translation = np.ascontiguousarray(inverse[:3, :3]), np.ascontiguousarray(inverse[:3, 3])
        return cls(rotation, translation, intrinsics, camera.width, camera.height)


def project(parameters: F32, camera: Pinhole) -> tuple[F32, Bools]:
    """Splats (N, 14) as the camera sees them: (N, 11) with the columns above, and (N,) whether they are visible."""
    projected, visible = np.zeros((len(parameters), PROJECTED), np.float32), np.zeros(len(parameters), np.bool_)
    _project(parameters, *camera, MIN_ALPHA, projected, visible)
    return projected, visible


def parameter_gradients(parameters: F32, camera: Pinhole, projected: F32, index: I32, first: I32, entries: F32) -> F32:
    """Gradients (M, 14) of visible splats by those of their entries in tiles.

    Args:
        parameters: (N, 14) of all splats.
        camera: the camera.
        projected: (N, 11).
        index: (M,) the visible splats.
        first: (M + 1,) first entry of each of them.
        entries: (E, 10) gradients of the entries, those of a splat in sequence.
    """
    gradients = np.empty((len(index), parameters.shape[1]), np.float32)
    _parameter_gradients(
        parameters, camera.rotation, camera.translation, camera.intrinsics, camera.width, camera.height,
        projected, index, first, entries, gradients,
    )  # fmt: skip
    return gradients


@njit(cache=True, inline="always")
def _rotation(parameters, i, out):  # type: ignore[no-untyped-def]
    """Rotation matrix of a splat, and the length of its quaternion."""
    w, x, y, z = parameters[i, 6], parameters[i, 7], parameters[i, 8], parameters[i, 9]
    length = np.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w / length, x / length, y / length, z / length
    out[0, 0], out[0, 1], out[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    out[1, 0], out[1, 1], out[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    out[2, 0], out[2, 1], out[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return length


@njit(cache=True, inline="always")
def _slopes(parameters, i, normals, x, y, z):  # type: ignore[no-untyped-def]
    """Change of a splat's inverse depth per unit of x / z and y / z: that of the plane through its two longer axes.

    The rounder a splat is, the smaller is the slope; that of a ball is 0.

    Args:
        parameters, i: the splat.
        normals: (3, 3) its axes in columns, in camera axes.
        x, y, z: its centre in camera axes.
    """
    thin = 0
    for k in range(1, 3):
        if parameters[i, 3 + k] < parameters[i, 3 + thin]:
            thin = k
    middle = min(parameters[i, 3 + (thin + 1) % 3], parameters[i, 3 + (thin + 2) % 3])
    roundness = np.exp(4 * (parameters[i, 3 + thin] - middle))
    n0, n1, n2 = normals[0, thin], normals[1, thin], normals[2, thin]
    along = n0 * x + n1 * y + n2 * z
    share = np.float32(MIN_SLOPE_COS) ** 2 * (x * x + y * y + z * z)
    factor = (1 - roundness) * along / (along * along + share)
    return factor * n0, factor * n1


@njit(cache=True, inline="always")
def _limits(intrinsics, width, height):  # type: ignore[no-untyped-def]
    """Bounds of x / z and y / z at which the projection is linearized."""
    margin = np.float32(FIELD_MARGIN - 1) / 2
    left = -(intrinsics[2] + margin * width) / intrinsics[0]
    right = (width - intrinsics[2] + margin * width) / intrinsics[0]
    top = -(intrinsics[3] + margin * height) / intrinsics[1]
    bottom = (height - intrinsics[3] + margin * height) / intrinsics[1]
    return left, right, top, bottom


@njit(cache=True, parallel=True, fastmath=FASTMATH, error_model="numpy")
def _project(  # type: ignore[no-untyped-def]
    parameters, R, t, intrinsics, width, height, min_alpha, projected, visible
):
    left, right, top, bottom = _limits(intrinsics, width, height)
    fx, fy = intrinsics[0], intrinsics[1]
    for i in prange(len(parameters)):
        px, py, pz = parameters[i, 0], parameters[i, 1], parameters[i, 2]
        z = R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz + t[2]
        if z < np.float32(NEAR_M):
            continue
        opacity = 1 / (1 + np.exp(-parameters[i, 10]))
        if opacity <= min_alpha:
            continue
        x = R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz + t[0]
        y = R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz + t[1]
        u, v = fx * x / z + intrinsics[2], fy * y / z + intrinsics[3]
        j00, j11 = fx / z, fy / z
        j02 = -j00 * min(max(x / z, left), right)
        j12 = -j11 * min(max(y / z, top), bottom)
        Q, axes = np.empty((3, 3), np.float32), np.empty((3, 3), np.float32)
        _rotation(parameters, i, Q)
        a, b, c = np.float32(LOW_PASS), np.float32(0), np.float32(LOW_PASS)
        for k in range(3):
            scale = np.exp(parameters[i, 3 + k])
            q0 = R[0, 0] * Q[0, k] + R[0, 1] * Q[1, k] + R[0, 2] * Q[2, k]
            q1 = R[1, 0] * Q[0, k] + R[1, 1] * Q[1, k] + R[1, 2] * Q[2, k]
            q2 = R[2, 0] * Q[0, k] + R[2, 1] * Q[1, k] + R[2, 2] * Q[2, k]
            m0, m1 = scale * (j00 * q0 + j02 * q2), scale * (j11 * q1 + j12 * q2)
            a, b, c = a + m0 * m0, b + m0 * m1, c + m1 * m1
            axes[0, k], axes[1, k], axes[2, k] = q0, q1, q2
            Q[0, k], Q[1, k] = m0, m1  # of its column no other axis depends
        # a c - b b as a sum of squares (Lagrange's identity): the difference of long and narrow splats would be rounded
        determinant = np.float32(LOW_PASS) * (a + c - np.float32(LOW_PASS))
        for k in range(3):
            m0, m1 = Q[0, k], Q[1, k]
            for other in range(k):
                minor = m0 * Q[1, other] - m1 * Q[0, other]
                determinant += minor * minor
        if not (0 < determinant < np.inf):
            continue
        farthest = 2 * np.log(opacity / min_alpha)
        extent_x, extent_y = np.sqrt(farthest * a), np.sqrt(farthest * c)
        if u + extent_x < 0 or u - extent_x > width - 1 or v + extent_y < 0 or v - extent_y > height - 1:
            continue
        projected[i, 0], projected[i, 1] = u, v
        projected[i, 2], projected[i, 3], projected[i, 4] = c / determinant, -b / determinant, a / determinant
        projected[i, 5], projected[i, 6], projected[i, 7], projected[i, 8] = opacity, extent_x, extent_y, z
        slope_x, slope_y = _slopes(parameters, i, axes, x, y, z)
        projected[i, 9], projected[i, 10] = slope_x / fx, slope_y / fy
        visible[i] = True


@njit(cache=True, parallel=True, fastmath=FASTMATH, error_model="numpy")
def _parameter_gradients(  # type: ignore[no-untyped-def]
    parameters, R, t, intrinsics, width, height, projected, index, first, entries, gradients
):
    left, right, top, bottom = _limits(intrinsics, width, height)
    fx, fy = intrinsics[0], intrinsics[1]
    for m in prange(len(index)):
        i = index[m]
        g = np.zeros(GRADIENT, np.float32)
        for e in range(first[m], first[m + 1]):
            for k in range(GRADIENT):
                g[k] += entries[e, k]
        px, py, pz = parameters[i, 0], parameters[i, 1], parameters[i, 2]
        x = R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz + t[0]
        y = R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz + t[1]
        z = projected[i, 8]
        ratio_x, ratio_y = min(max(x / z, left), right), min(max(y / z, top), bottom)
        j00, j11 = fx / z, fy / z
        j02, j12 = -j00 * ratio_x, -j11 * ratio_y
        # by the inverse covariance C: the covariance's gradient is -C G C
        A, B, C = projected[i, 2], projected[i, 3], projected[i, 4]
        g00, g01, g11 = g[7], g[8] / 2, g[9]
        p00, p01 = A * g00 + B * g01, A * g01 + B * g11
        p10, p11 = B * g00 + C * g01, B * g01 + C * g11
        s00, s01, s11 = -(p00 * A + p01 * B), -(p00 * B + p01 * C), -(p10 * B + p11 * C)
        Q, W = np.empty((3, 3), np.float32), np.empty((3, 3), np.float32)
        length = _rotation(parameters, i, Q)
        d00, d02, d11, d12 = np.float32(0), np.float32(0), np.float32(0), np.float32(0)
        for k in range(3):
            scale = np.exp(parameters[i, 3 + k])
            q0 = R[0, 0] * Q[0, k] + R[0, 1] * Q[1, k] + R[0, 2] * Q[2, k]
            q1 = R[1, 0] * Q[0, k] + R[1, 1] * Q[1, k] + R[1, 2] * Q[2, k]
            q2 = R[2, 0] * Q[0, k] + R[2, 1] * Q[1, k] + R[2, 2] * Q[2, k]
            m0, m1 = scale * (j00 * q0 + j02 * q2), scale * (j11 * q1 + j12 * q2)
            h0, h1 = 2 * (s00 * m0 + s01 * m1), 2 * (s01 * m0 + s11 * m1)
            gradients[m, 3 + k] = h0 * m0 + h1 * m1
            h0, h1 = h0 * scale, h1 * scale
            d00, d02, d11, d12 = d00 + h0 * q0, d02 + h0 * q2, d11 + h1 * q1, d12 + h1 * q2
            for row in range(3):
                W[row, k] = h0 * (j00 * R[0, row] + j02 * R[2, row]) + h1 * (j11 * R[1, row] + j12 * R[2, row])
        # position in the camera, by the centre in the image, from which the inverse depth changes with its slope, and
        # by the linearization there
        by_u, by_v = g[5] - g[3] * projected[i, 9], g[6] - g[3] * projected[i, 10]
        dx, dy = by_u * fx / z, by_v * fy / z
        dz = -(g[3] + by_u * fx * x + by_v * fy * y) / (z * z)
        dz += (-d00 * j00 - d11 * j11 - d02 * j02 - d12 * j12) / z
        if left < x / z < right:
            dx -= d02 * fx / (z * z)
            dz -= d02 * j02 / z
        if top < y / z < bottom:
            dy -= d12 * fy / (z * z)
            dz -= d12 * j12 / z
        for k in range(3):
            gradients[m, k] = R[0, k] * dx + R[1, k] * dy + R[2, k] * dz
        w, i1, i2, i3 = (
            parameters[i, 6] / length, parameters[i, 7] / length, parameters[i, 8] / length, parameters[i, 9] / length
        )  # fmt: skip
        dw = 2 * (-i3 * W[0, 1] + i2 * W[0, 2] + i3 * W[1, 0] - i1 * W[1, 2] - i2 * W[2, 0] + i1 * W[2, 1])
        d1 = 2 * (
            i2 * W[0, 1] + i3 * W[0, 2] + i2 * W[1, 0] - 2 * i1 * W[1, 1] - w * W[1, 2]
            + i3 * W[2, 0] + w * W[2, 1] - 2 * i1 * W[2, 2]
        )  # fmt: skip
        d2 = 2 * (
            -2 * i2 * W[0, 0] + i1 * W[0, 1] + w * W[0, 2] + i1 * W[1, 0] + i3 * W[1, 2]
            - w * W[2, 0] + i3 * W[2, 1] - 2 * i2 * W[2, 2]
        )  # fmt: skip
        d3 = 2 * (
            -2 * i3 * W[0, 0] - w * W[0, 1] + i1 * W[0, 2] + w * W[1, 0] - 2 * i3 * W[1, 1]
            + i2 * W[1, 2] + i1 * W[2, 0] + i2 * W[2, 1]
        )  # fmt: skip
        along = w * dw + i1 * d1 + i2 * d2 + i3 * d3
        gradients[m, 6], gradients[m, 7] = (dw - w * along) / length, (d1 - i1 * along) / length
        gradients[m, 8], gradients[m, 9] = (d2 - i2 * along) / length, (d3 - i3 * along) / length
        opacity = projected[i, 5]
        gradients[m, 10] = g[4] * opacity * (1 - opacity)
        gradients[m, 11], gradients[m, 12], gradients[m, 13] = g[0], g[1], g[2]
