"""Kernels of `pipeline.visibility`: discs into a range image, points tested against it.

Footprints are sorted into bands of rows, one thread a band, so that no two threads write one pixel and
the result does not depend on their number. Import this module late: it loads numba.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from scan2sim.pipeline.cameras import EQUIRECTANGULAR, FISHEYE, ORTHOGRAPHIC, project_point
from scan2sim.pipeline.types import F32, F64

BAND = 32
SLOPE_SHARE = 0.4
"""Of a pixel's footprint times the slope, what is added to the bias; more leaks, less hides falsely."""
MAX_SLOPE = 30.0
"""tan(incidence) beyond which the bias grows no more (88 degrees)."""
MAX_DISC = 40
"""Discs are drawn at most this many pixels to each side: one that near to the camera is noise."""


def draw_discs(
    depth: F32, rays: F32, model: int, p: F64, T_cam_world: F64, centres: F32, normals: F32, radii: F32
) -> None:
    """Draw discs, centres (N, 3) and unit normals (N, 3) in local coordinates, radii (N,) metres, in place."""
    at = _to_camera(centres, T_cam_world)
    turned = T_cam_world.copy()
    turned[:3, 3] = 0
    discs = np.ascontiguousarray(
        np.stack([at, _to_camera(normals, turned), np.repeat(radii[:, None], 3, axis=1)], axis=1)
    )
    boxes = _disc_boxes(discs, model, p)
    start, index = _bands(boxes, depth.shape[0])
    _fill(depth, rays, discs, boxes, start, index, model, p)


@njit(cache=True, parallel=True)
def _to_camera(points, T):  # type: ignore[no-untyped-def]
    out = np.empty((len(points), 3), np.float32)
    for i in prange(len(points)):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        for k in range(3):
            out[i, k] = T[k, 0] * x + T[k, 1] * y + T[k, 2] * z + T[k, 3]
    return out


@njit(cache=True, parallel=True)
def _disc_boxes(discs, model, p):  # type: ignore[no-untyped-def]
    boxes = np.empty((len(discs), 4), np.int32)
    width, height = p[12], p[13]
    for i in prange(len(discs)):
        boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3] = 0, 0, -1, -1
        x, y, z = discs[i, 0, 0], discs[i, 0, 1], discs[i, 0, 2]
        u, v, ok = project_point(model, p, x, y, z)
        r = math.sqrt(x * x + y * y + z * z)
        if not ok or r < 0.5:
            continue
        angle = discs[i, 2, 0] / r
        if model == ORTHOGRAPHIC:
            du = dv = discs[i, 2, 0] * max(p[0], p[1])
        elif model == EQUIRECTANGULAR:
            dv = angle * height / math.pi
            du = dv / max(0.1, math.sqrt(x * x + z * z) / r)
        else:
            du = dv = angle * max(p[0], p[1]) * min(4.0, r / max(1e-6, abs(z)) if model != FISHEYE else 1.0)
        du, dv = min(du, MAX_DISC), min(dv, MAX_DISC)
        u0, u1 = int(math.floor(u - du)), int(math.ceil(u + du))
        v0, v1 = max(0, int(math.floor(v - dv))), min(int(height) - 1, int(math.ceil(v + dv)))
        if model != EQUIRECTANGULAR:
            u0, u1 = max(u0, 0), min(u1, int(width) - 1)
        if u0 <= u1 and v0 <= v1:
            boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3] = u0, v0, u1, v1
    return boxes


@njit(cache=True)
def _bands(boxes, height):  # type: ignore[no-untyped-def]
    """Footprints sorted into bands of rows: (start (B+1,), indices), in their own order within a band."""
    n = (height + BAND - 1) // BAND
    start = np.zeros(n + 1, np.int64)
    for i in range(len(boxes)):
        if boxes[i, 3] >= boxes[i, 1]:
            for b in range(boxes[i, 1] // BAND, boxes[i, 3] // BAND + 1):
                start[b + 1] += 1
    for b in range(n):
        start[b + 1] += start[b]
    index = np.empty(start[n], np.int32)
    at = start.copy()
    for i in range(len(boxes)):
        if boxes[i, 3] >= boxes[i, 1]:
            for b in range(boxes[i, 1] // BAND, boxes[i, 3] // BAND + 1):
                index[at[b]] = i
                at[b] += 1
    return start, index


@njit(cache=True, parallel=True)
def _fill(depth, rays, discs, boxes, start, index, model, p):  # type: ignore[no-untyped-def]
    """Keep in every pixel the least range at which its ray meets a disc."""
    height, width = depth.shape
    for band in prange(len(start) - 1):
        first, last = band * BAND, min(height, (band + 1) * BAND) - 1
        for j in range(start[band], start[band + 1]):
            i = index[j]
            s = discs[i]
            for v in range(max(first, boxes[i, 1]), min(last, boxes[i, 3]) + 1):
                for column in range(boxes[i, 0], boxes[i, 2] + 1):
                    u = column % width
                    ray = rays[v, u]
                    x0 = y0 = 0.0  # where the ray begins
                    if model == ORTHOGRAPHIC:
                        x0, y0 = (u - p[2]) / p[0], (v - p[3]) / p[1]
                    t = _meet_disc(ray, s, x0, y0)
                    if 0 < t < depth[v, u]:  # a NaN ray meets nothing
                        depth[v, u] = t


@njit(cache=True, inline="always")
def _meet_disc(d, s, x0, y0):  # type: ignore[no-untyped-def]
    """Range at which the unit ray d from (x0, y0, 0) meets the disc s: centre, normal, radius; -1 if it does not."""
    along = d[0] * s[1, 0] + d[1] * s[1, 1] + d[2] * s[1, 2]
    if abs(along) < 0.05:  # seen edge-on
        return -1.0
    cx, cy = s[0, 0] - x0, s[0, 1] - y0
    t = (cx * s[1, 0] + cy * s[1, 1] + s[0, 2] * s[1, 2]) / along
    x, y, z = d[0] * t - cx, d[1] * t - cy, d[2] * t - s[0, 2]
    return t if x * x + y * y + z * z <= s[2, 0] * s[2, 0] else -1.0


@njit(cache=True)
def is_visible(depth, model, p, pixel, bias, x, y, z, nx, ny, nz):  # type: ignore[no-untyped-def]
    """Whether a view sees a point; every test of visibility is this one.

    Args:
        depth: (H, W) range image.
        model, p: its camera (`pipeline.cameras`).
        pixel: radians that a pixel spans (`cameras.pixel_angle`).
        bias: metres, see `pipeline.visibility.BIAS`.
        x, y, z: the point, camera axes, metres.
        nx, ny, nz: the surface's unit normal there, camera axes, either side; zero: seen head-on.
    """
    u, v, ok = project_point(model, p, x, y, z)
    if not ok:
        return False
    height, width = depth.shape
    column, row = int(math.floor(u + 0.5)), int(math.floor(v + 0.5))
    if model == EQUIRECTANGULAR:
        column %= width
    if column < 0 or row < 0 or column >= width or row >= height:
        return False
    if model == ORTHOGRAPHIC:
        return z <= depth[row, column] + bias + SLOPE_SHARE * pixel * slope_of(abs(nz))
    r = math.sqrt(x * x + y * y + z * z)
    slope = 0.0
    if nx != 0 or ny != 0 or nz != 0:
        slope = slope_of(abs(x * nx + y * ny + z * nz) / r)
    return r <= depth[row, column] + bias + SLOPE_SHARE * r * pixel * slope


@njit(cache=True, inline="always")
def slope_of(cos):  # type: ignore[no-untyped-def]
    """tan of the angle of incidence, bounded: a pixel's own ray meets a plane nearer by this times half the pixel."""
    c = min(1.0, cos)
    return min(MAX_SLOPE, math.sqrt(1 - c * c) / max(c, 1e-6))


@njit(cache=True, parallel=True)
def points_visible(depth, model, p, T_cam_world, points, normals, bias, pixel):  # type: ignore[no-untyped-def]
    """(N,) bool: `is_visible` for points (N, 3) and normals (N, 3), or (0, 3) for none, in local coordinates."""
    seen = np.zeros(len(points), np.bool_)
    T = T_cam_world
    for i in prange(len(points)):
        x = T[0, 0] * points[i, 0] + T[0, 1] * points[i, 1] + T[0, 2] * points[i, 2] + T[0, 3]
        y = T[1, 0] * points[i, 0] + T[1, 1] * points[i, 1] + T[1, 2] * points[i, 2] + T[1, 3]
        z = T[2, 0] * points[i, 0] + T[2, 1] * points[i, 1] + T[2, 2] * points[i, 2] + T[2, 3]
        nx = ny = nz = 0.0
        if len(normals) > 0:
            nx = T[0, 0] * normals[i, 0] + T[0, 1] * normals[i, 1] + T[0, 2] * normals[i, 2]
            ny = T[1, 0] * normals[i, 0] + T[1, 1] * normals[i, 1] + T[1, 2] * normals[i, 2]
            nz = T[2, 0] * normals[i, 0] + T[2, 1] * normals[i, 1] + T[2, 2] * normals[i, 2]
        seen[i] = is_visible(depth, model, p, pixel, bias, x, y, z, nx, ny, nz)
    return seen
