"""Kernels of `pipeline.camera.depth_map`: disc splatting into a range image.

Footprints are sorted into bands of rows, and each band is rendered by one thread: no two threads write the same pixel,
and the result does not depend on the number of threads. Import this module lazily: it loads numba.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from scan2sim.pipeline.camera.models import EQUIRECTANGULAR, FISHEYE, ORTHOGRAPHIC, project_point
from scan2sim.pipeline.camera.projection import PosedCamera, rotate_to_camera, to_camera
from scan2sim.pipeline.core.types import F32, I32, I64

BAND_ROWS = 32
MAX_DISC_RADIUS_PX = 40
"""Discs are cropped to this radius: a larger one is so near to the camera that it is noise."""


def draw_discs(depth: F32, rays: F32, camera: PosedCamera, centres: F32, normals: F32, radii: F32) -> None:
    """Render discs into `depth` in place: centres and unit normals (N, 3) in local coordinates, radii (N,) metres."""
    discs = _discs(camera, centres, normals, radii)
    boxes = _disc_boxes(camera, discs)
    start, index = _bands(boxes, depth.shape[0])
    _fill(depth, rays, camera, discs, boxes, start, index)


@njit(cache=True, parallel=True)
def _discs(camera: PosedCamera, centres: F32, normals: F32, radii: F32) -> F32:
    """Discs (N, 3, 3) float32: centre and normal in camera axes, and radius."""
    out = np.empty((len(centres), 3, 3), np.float32)
    for i in prange(len(centres)):
        c, n = centres[i], normals[i]
        out[i, 0, 0], out[i, 0, 1], out[i, 0, 2] = to_camera(camera.T, c[0], c[1], c[2])
        out[i, 1, 0], out[i, 1, 1], out[i, 1, 2] = rotate_to_camera(camera.T, n[0], n[1], n[2])
        out[i, 2] = radii[i]
    return out


@njit(cache=True, parallel=True)
def _disc_boxes(camera: PosedCamera, discs: F32) -> I32:
    """Bounding boxes (N, 4) of the footprints in pixels: u0, v0, u1, v1, inclusive; on panoramas, u may wrap around."""
    boxes = np.empty((len(discs), 4), np.int32)
    model, p = camera.model, camera.p
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
        du, dv = min(du, MAX_DISC_RADIUS_PX), min(dv, MAX_DISC_RADIUS_PX)
        u0, u1 = int(math.floor(u - du)), int(math.ceil(u + du))
        v0, v1 = max(0, int(math.floor(v - dv))), min(int(height) - 1, int(math.ceil(v + dv)))
        if model != EQUIRECTANGULAR:
            u0, u1 = max(u0, 0), min(u1, int(width) - 1)
        if u0 <= u1 and v0 <= v1:
            boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3] = u0, v0, u1, v1
    return boxes


@njit(cache=True)
def _bands(boxes: I32, height: int) -> tuple[I64, I32]:
    """Indices of the footprints grouped by band of rows: (start (B+1,), indices), in ascending order within a band."""
    n = (height + BAND_ROWS - 1) // BAND_ROWS
    start = np.zeros(n + 1, np.int64)
    for i in range(len(boxes)):
        if boxes[i, 3] >= boxes[i, 1]:
            for b in range(boxes[i, 1] // BAND_ROWS, boxes[i, 3] // BAND_ROWS + 1):
                start[b + 1] += 1
    for b in range(n):
        start[b + 1] += start[b]
    index = np.empty(start[n], np.int32)
    at = start.copy()
    for i in range(len(boxes)):
        if boxes[i, 3] >= boxes[i, 1]:
            for b in range(boxes[i, 1] // BAND_ROWS, boxes[i, 3] // BAND_ROWS + 1):
                index[at[b]] = i
                at[b] += 1
    return start, index


@njit(cache=True, parallel=True)
def _fill(depth: F32, rays: F32, camera: PosedCamera, discs: F32, boxes: I32, start: I64, index: I32) -> None:
    """Store in every pixel the smallest range at which its ray meets a disc."""
    p = camera.p
    height, width = depth.shape
    for band in prange(len(start) - 1):
        first, last = band * BAND_ROWS, min(height, (band + 1) * BAND_ROWS) - 1
        for j in range(start[band], start[band + 1]):
            i = index[j]
            s = discs[i]
            for v in range(max(first, boxes[i, 1]), min(last, boxes[i, 3]) + 1):
                for column in range(boxes[i, 0], boxes[i, 2] + 1):
                    u = column % width
                    ray = rays[v, u]
                    x0 = y0 = 0.0  # origin of the ray
                    if camera.model == ORTHOGRAPHIC:
                        x0, y0 = (u - p[2]) / p[0], (v - p[3]) / p[1]
                    t = _intersect_disc(ray, s, x0, y0)
                    if 0 < t < depth[v, u]:  # a NaN ray meets nothing
                        depth[v, u] = t


@njit(cache=True, inline="always")
def _intersect_disc(d: F32, s: F32, x0: float, y0: float) -> float:
    """Range at which the unit ray d from (x0, y0, 0) meets the disc s (centre, normal, radius); -1 if it misses."""
    along = d[0] * s[1, 0] + d[1] * s[1, 1] + d[2] * s[1, 2]
    if abs(along) < 0.05:  # seen edge-on
        return -1.0
    cx, cy = s[0, 0] - x0, s[0, 1] - y0
    t = (cx * s[1, 0] + cy * s[1, 1] + s[0, 2] * s[1, 2]) / along
    x, y, z = d[0] * t - cx, d[1] * t - cy, d[2] * t - s[0, 2]
    return t if x * x + y * y + z * z <= s[2, 0] * s[2, 0] else -1.0
