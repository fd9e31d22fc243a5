"""Kernels of `pipeline.visibility`: triangles and discs into a range image, points tested against it.

Footprints are sorted into bands of rows, one thread a band, so that no two threads write one pixel and
the result does not depend on their number. Import this module late: it loads numba.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from pipeline.cameras import EQUIRECTANGULAR, FISHEYE, PINHOLE, project_point
from pipeline.types import F32, F64

BAND = 32
MAX_SLOPE = 30.0
"""tan(incidence) beyond which the bias grows no more (88 degrees)."""
SPLITS = 4
"""Triangles partly out of view are split this many times to find their footprint."""
MAX_DISC = 40
"""Discs are drawn at most this many pixels to each side: one that near to the camera is noise."""


def draw_triangles(depth: F32, rays: F32, model: int, p: F64, T_cam_world: F64, triangles: F32) -> None:
    """Draw triangles (F, 3, 3), local coordinates, into the range image `depth` (H, W), in place.

    `rays` (H, W, 3) are the pixels' unit rays; `model`, `p` the camera (`pipeline.cameras`).
    """
    corners = _to_camera(triangles.reshape(-1, 3), T_cam_world).reshape(-1, 3, 3)
    boxes = _triangle_boxes(corners, model, p)
    _fill(depth, rays, corners, boxes, *_bands(boxes, depth.shape[0]))


def draw_discs(
    depth: F32, rays: F32, model: int, p: F64, T_cam_world: F64, centres: F32, normals: F32, radius: float
) -> None:
    """Draw discs, centres (N, 3) and unit normals (N, 3) in local coordinates, radius in metres, in place."""
    at = _to_camera(centres, T_cam_world)
    turned = T_cam_world.copy()
    turned[:3, 3] = 0
    discs = np.ascontiguousarray(np.stack([at, _to_camera(normals, turned), np.full_like(at, radius)], axis=1))
    boxes = _disc_boxes(discs, model, p)
    _fill(depth, rays, discs, boxes, *_bands(boxes, depth.shape[0]), True)


@njit(cache=True, parallel=True)
def _to_camera(points, T):  # type: ignore[no-untyped-def]
    out = np.empty((len(points), 3), np.float32)
    for i in prange(len(points)):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        for k in range(3):
            out[i, k] = T[k, 0] * x + T[k, 1] * y + T[k, 2] * z + T[k, 3]
    return out


@njit(cache=True)
def _wide(s):  # type: ignore[no-untyped-def]
    """Whether an edge of the triangle (3, 3) spans more than about 0.15 rad, so that distortion bends it visibly."""
    near, longest = np.inf, 0.0
    for k in range(3):
        m = (k + 1) % 3
        near = min(near, s[k, 0] ** 2 + s[k, 1] ** 2 + s[k, 2] ** 2)
        longest = max(longest, (s[k, 0] - s[m, 0]) ** 2 + (s[k, 1] - s[m, 1]) ** 2 + (s[k, 2] - s[m, 2]) ** 2)
    return longest > 0.0225 * near


@njit(cache=True)
def _whole(model, p, s, level):  # type: ignore[no-untyped-def]
    """1 if the corners of triangle (3, 3) bound its footprint, 0 if it must be split to know, -1 if it is out of view."""
    hidden = 0
    for k in range(3):
        hidden += not project_point(model, p, s[k, 0], s[k, 1], s[k, 2])[2]
    if hidden == 3 and s[0, 2] < 0 and s[1, 2] < 0 and s[2, 2] < 0:
        return -1
    return 0 if level > 0 and (hidden > 0 or (model != PINHOLE and _wide(s))) else 1


@njit(cache=True)
def _take_in(box, model, p, s):  # type: ignore[no-untyped-def]
    """Grow a footprint (u0, v0, u1, v1) by those corners of a triangle (3, 3) that are in view.

    Around the back of a full sphere columns are unrolled to be next to the footprint's first ones.
    """
    for k in range(3):
        u, v, ok = project_point(model, p, s[k, 0], s[k, 1], s[k, 2])
        if not ok:
            continue
        if model == EQUIRECTANGULAR and box[0] <= box[2]:
            u -= round((u - 0.5 * (box[0] + box[2])) / p[12]) * p[12]
        box[0], box[1] = min(box[0], u), min(box[1], v)
        box[2], box[3] = max(box[2], u), max(box[3], v)


@njit(cache=True)
def _grow(box, model, p, triangle):  # type: ignore[no-untyped-def]
    """Grow a footprint by a triangle (3, 3); one that is partly out of view or bent is split into four, again and again."""
    state = _whole(model, p, triangle, SPLITS)
    if state == 1:
        _take_in(box, model, p, triangle)
    if state != 0:
        return
    waiting = np.empty((3 * SPLITS + 4, 3, 3), np.float32)
    level = np.empty(len(waiting), np.int64)
    waiting[0], level[0], n = triangle, SPLITS, 1
    while n > 0:
        n -= 1
        s, deep = waiting[n].copy(), level[n]
        state = _whole(model, p, s, deep)
        if state == 1:
            _take_in(box, model, p, s)
        if state == 0:
            for part in range(4):  # three at the corners, and the middle one
                for k in range(3):
                    a, b = (part, k) if part < 3 else (k, (k + 1) % 3)
                    for c in range(3):
                        waiting[n, k, c] = np.float32(0.5) * (s[a, c] + s[b, c])
                level[n] = deep - 1
                n += 1


@njit(cache=True)
def _clamp(box, width, height, margin):  # type: ignore[no-untyped-def]
    """Footprint to whole pixels within the image's rows; columns are clamped by the caller's wrapping."""
    return (
        int(math.floor(max(-1e6, box[0]) - margin)),
        int(math.floor(max(0.0, box[1] - margin))),
        int(math.ceil(min(1e6, box[2]) + margin)),
        int(math.ceil(min(height - 1.0, box[3] + margin))),
    )


@njit(cache=True, parallel=True)
def _triangle_boxes(corners, model, p):  # type: ignore[no-untyped-def]
    """(F, 4) int32 footprints u0 v0 u1 v1, inclusive; v1 < v0 for what is out of view."""
    boxes = np.empty((len(corners), 4), np.int32)
    width, height = p[12], p[13]
    curved = 0.0 if model == PINHOLE else 0.02
    for i in prange(len(corners)):
        box = np.array([np.inf, np.inf, -np.inf, -np.inf])
        _grow(box, model, p, corners[i])
        boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3] = 0, 0, -1, -1
        if box[0] > box[2]:
            continue
        margin = 1 + curved * max(box[2] - box[0], box[3] - box[1])  # edges bend under distortion
        u0, v0, u1, v1 = _clamp(box, width, height, margin)
        if model != EQUIRECTANGULAR:
            u0, u1 = max(u0, 0), min(u1, int(width) - 1)
        else:
            if v0 < 0.1 * height or v1 > 0.9 * height:  # near a pole: the triangle may go around it
                u0, u1 = 0, int(width) - 1
                v0, v1 = (0, v1) if v0 < 0.1 * height else (v0, int(height) - 1)
            if u1 - u0 >= width:
                u0, u1 = 0, int(width) - 1
        if u0 <= u1 and v0 <= v1:
            boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3] = u0, v0, u1, v1
    return boxes


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
        if model == EQUIRECTANGULAR:
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
def _fill(depth, rays, shapes, boxes, start, index, disc=False):  # type: ignore[no-untyped-def]
    """Keep in every pixel the least range at which its ray meets a shape: a triangle's corners, or a disc."""
    height, width = depth.shape
    for band in prange(len(start) - 1):
        first, last = band * BAND, min(height, (band + 1) * BAND) - 1
        for j in range(start[band], start[band + 1]):
            i = index[j]
            s = shapes[i]
            for v in range(max(first, boxes[i, 1]), min(last, boxes[i, 3]) + 1):
                for column in range(boxes[i, 0], boxes[i, 2] + 1):
                    u = column % width
                    ray = rays[v, u]
                    t = _meet_disc(ray, s) if disc else _meet_triangle(ray, s)
                    if 0 < t < depth[v, u]:  # a NaN ray meets nothing
                        depth[v, u] = t


@njit(cache=True, inline="always")
def _meet_triangle(d, s):  # type: ignore[no-untyped-def]
    """Range at which the unit ray d meets the triangle s (3, 3), -1 if it does not (Moeller and Trumbore 1997)."""
    ax, ay, az = s[0, 0], s[0, 1], s[0, 2]
    e1x, e1y, e1z = s[1, 0] - ax, s[1, 1] - ay, s[1, 2] - az
    e2x, e2y, e2z = s[2, 0] - ax, s[2, 1] - ay, s[2, 2] - az
    px, py, pz = d[1] * e2z - d[2] * e2y, d[2] * e2x - d[0] * e2z, d[0] * e2y - d[1] * e2x
    det = e1x * px + e1y * py + e1z * pz
    if abs(det) < 1e-12:
        return -1.0
    f = 1.0 / det
    eps = 1e-4  # no cracks between neighbours
    b1 = -(ax * px + ay * py + az * pz) * f
    if b1 < -eps or b1 > 1 + eps:
        return -1.0
    qx, qy, qz = -(ay * e1z - az * e1y), -(az * e1x - ax * e1z), -(ax * e1y - ay * e1x)
    b2 = (d[0] * qx + d[1] * qy + d[2] * qz) * f
    if b2 < -eps or b1 + b2 > 1 + eps:
        return -1.0
    return (e2x * qx + e2y * qy + e2z * qz) * f


@njit(cache=True, inline="always")
def _meet_disc(d, s):  # type: ignore[no-untyped-def]
    """Range at which the unit ray d meets the disc s: centre, normal, radius; -1 if it does not."""
    along = d[0] * s[1, 0] + d[1] * s[1, 1] + d[2] * s[1, 2]
    if abs(along) < 0.05:  # seen edge-on
        return -1.0
    t = (s[0, 0] * s[1, 0] + s[0, 1] * s[1, 1] + s[0, 2] * s[1, 2]) / along
    x, y, z = d[0] * t - s[0, 0], d[1] * t - s[0, 1], d[2] * t - s[0, 2]
    return t if x * x + y * y + z * z <= s[2, 0] * s[2, 0] else -1.0


@njit(cache=True)
def is_visible(depth, model, p, pixel, bias, x, y, z, nx, ny, nz):  # type: ignore[no-untyped-def]
    """Whether a view sees a point; every test of visibility is this one.

    Args:
        depth: (H, W) range image.
        model, p: its camera (`pipeline.cameras`).
        pixel: radians that a pixel spans.
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
    r = math.sqrt(x * x + y * y + z * z)
    slope = 0.0
    if nx != 0 or ny != 0 or nz != 0:
        c = min(1.0, abs(x * nx + y * ny + z * nz) / r)
        slope = min(MAX_SLOPE, math.sqrt(1 - c * c) / max(c, 1e-6))
    # a neighbour on the same plane may be nearer by footprint times slope, half a pixel away to each side
    return r <= depth[row, column] + bias + r * pixel * slope


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
