"""Kernels that paint a page: whose texel is it, and what do the photos say of it. Import late: it loads numba.

Texel (x, y) of a page of W x H has its centre at u = (x + 0.5) / W, v = 1 - (y + 0.5) / H.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from pipeline.cameras import EQUIRECTANGULAR, project_point
from pipeline.range_image import is_visible
from pipeline.types import F32, I32

BAND = 32
EDGE = 0.01
"""Share of its weight that a photo keeps beside something that hides what is behind."""


def texels(uv: F32, width: int, height: int) -> F32:
    """(F, 3, 2) float32 places of the corners on a page, in texels (x right, y down, centres at integers)."""
    return np.stack([uv[..., 0] * width - 0.5, (1 - uv[..., 1]) * height - 0.5], axis=-1).astype(np.float32)


def owners(flat: F32, width: int, height: int) -> I32:
    """(H, W) int32: the face, index into `flat` (F, 3, 2), whose triangle covers the texel's centre; -1 where none."""
    out = np.full((height, width), -1, np.int32)
    _own(flat, out)
    return out


@njit(cache=True)
def _box(flat, f, width, height):  # type: ignore[no-untyped-def]
    """Texels whose centres may be in face f: x0, y0, x1, y1, inclusive."""
    x0 = min(flat[f, 0, 0], flat[f, 1, 0], flat[f, 2, 0])
    x1 = max(flat[f, 0, 0], flat[f, 1, 0], flat[f, 2, 0])
    y0 = min(flat[f, 0, 1], flat[f, 1, 1], flat[f, 2, 1])
    y1 = max(flat[f, 0, 1], flat[f, 1, 1], flat[f, 2, 1])
    return (
        max(0, int(math.ceil(x0 - 1e-3))),
        max(0, int(math.ceil(y0 - 1e-3))),
        min(width - 1, int(math.floor(x1 + 1e-3))),
        min(height - 1, int(math.floor(y1 + 1e-3))),
    )


@njit(cache=True, parallel=True)
def _own(flat, owner):  # type: ignore[no-untyped-def]
    height, width = owner.shape
    bands = (height + BAND - 1) // BAND
    rows = np.empty((len(flat), 2), np.int32)
    for f in prange(len(flat)):
        _, rows[f, 0], _, rows[f, 1] = _box(flat, f, width, height)
    for band in prange(bands):  # a thread a band: no two write one texel
        first, last = band * BAND, min(height, (band + 1) * BAND) - 1
        for f in range(len(flat)):
            if rows[f, 1] < first or rows[f, 0] > last:
                continue
            ax, ay = np.float64(flat[f, 0, 0]), np.float64(flat[f, 0, 1])
            bx, by = flat[f, 1, 0] - ax, flat[f, 1, 1] - ay
            cx, cy = flat[f, 2, 0] - ax, flat[f, 2, 1] - ay
            det = bx * cy - by * cx
            if abs(det) < 1e-9:
                continue
            x0, y0, x1, y1 = _box(flat, f, width, height)
            for y in range(max(first, y0), min(last, y1) + 1):
                for x in range(x0, x1 + 1):
                    s = ((x - ax) * cy - (y - ay) * cx) / det
                    t = (bx * (y - ay) - by * (x - ax)) / det
                    if s >= -1e-6 and t >= -1e-6 and s + t <= 1 + 1e-6 and owner[y, x] < 0:
                        owner[y, x] = f


@njit(cache=True)
def frame(flat, corners, f):  # type: ignore[no-untyped-def]
    """The affine map of a face from texels to space: (origin, per x, per y), each (3,); and whether it has one."""
    ax, ay = np.float64(flat[f, 0, 0]), np.float64(flat[f, 0, 1])
    bx, by = flat[f, 1, 0] - ax, flat[f, 1, 1] - ay
    cx, cy = flat[f, 2, 0] - ax, flat[f, 2, 1] - ay
    det = bx * cy - by * cx
    origin, per_x, per_y = np.zeros(3), np.zeros(3), np.zeros(3)
    if abs(det) < 1e-9:
        return origin, per_x, per_y, False
    for k in range(3):
        e1 = np.float64(corners[f, 1, k]) - corners[f, 0, k]
        e2 = np.float64(corners[f, 2, k]) - corners[f, 0, k]
        per_x[k] = (e1 * cy - e2 * by) / det
        per_y[k] = (e2 * bx - e1 * cx) / det
        origin[k] = corners[f, 0, k] - ax * per_x[k] - ay * per_y[k]
    return origin, per_x, per_y, True


@njit(cache=True, inline="always")
def _sample(image, u, v, wrap):  # type: ignore[no-untyped-def]
    """Bilinear colour of a photo (H, W, 3) at a pixel."""
    height, width = image.shape[0], image.shape[1]
    u0, v0 = math.floor(u), math.floor(v)
    fu, fv = u - u0, v - v0
    a, b = int(u0), int(u0) + 1
    if wrap:
        a, b = a % width, b % width
    else:
        a, b = min(max(a, 0), width - 1), min(max(b, 0), width - 1)
    c, d = min(max(int(v0), 0), height - 1), min(max(int(v0) + 1, 0), height - 1)
    w00, w01, w10, w11 = (1 - fu) * (1 - fv), fu * (1 - fv), (1 - fu) * fv, fu * fv
    return (
        image[c, a, 0] * w00 + image[c, b, 0] * w01 + image[d, a, 0] * w10 + image[d, b, 0] * w11,
        image[c, a, 1] * w00 + image[c, b, 1] * w01 + image[d, a, 1] * w10 + image[d, b, 1] * w11,
        image[c, a, 2] * w00 + image[c, b, 2] * w01 + image[d, a, 2] * w10 + image[d, b, 2] * w11,
    )


@njit(cache=True, parallel=True)
def accumulate(  # type: ignore[no-untyped-def]
    total, owner, faces, flat, corners, normals, photo, mask, model, p, depth, near, depth_p, R, t, pixel,
    bias, power, feather, min_cos,
):  # fmt: skip
    """Add what one photo says to the texels of a page; returns the number of texels that it sees.

    Args:
        total: (H, W, 4) float32, sum of weight times RGB, and of weights; changed in place.
        owner: (H, W) of `owners`.
        faces: (N,) the faces that this photo textures, indices into `flat`.
        flat, corners, normals: (F, 3, 2) texels, (F, 3, 3) metres, (F, 3) unit, of the page's faces.
        photo: the photo and its halvings, (h, w, 3) uint8 each.
        mask: (h, w) uint8, 0 where it must not be used; (0, 0) for none.
        model, p: camera of the photo; `depth`, `depth_p`: range image and its camera.
        near: the least range around every pixel of `depth`; beside something nearer the photo's own pixels
            mix both, and its weight falls to `EDGE`.
        R, t: (3, 3) and (3,), camera from local.
        pixel: radians a pixel of the range image spans.
        bias: metres, of the visibility test.
        power: a photo's weight is (cos / distance^2) to this.
        feather: pixels over which the weight fades towards the photo's border.
        min_cos: as in the choice of views.
    """
    height, width = owner.shape
    wide = model == EQUIRECTANGULAR
    focal = p[12] / (2 * math.pi) if wide else min(p[0], p[1])
    used = np.zeros(len(faces), np.int64)
    for i in prange(len(faces)):
        f = faces[i]
        origin, per_x, per_y, ok = frame(flat, corners, f)
        if not ok:
            continue
        n = R @ normals[f].astype(np.float64)
        o = R @ origin + t
        dx, dy = R @ per_x, R @ per_y
        size = math.sqrt(max((dx * dx).sum(), (dy * dy).sum()))
        x0, y0, x1, y1 = _box(flat, f, width, height)
        for ty in range(y0, y1 + 1):
            for tx in range(x0, x1 + 1):
                if owner[ty, tx] != f:
                    continue
                x = o[0] + tx * dx[0] + ty * dy[0]
                y = o[1] + tx * dx[1] + ty * dy[1]
                z = o[2] + tx * dx[2] + ty * dy[2]
                u, v, ok = project_point(model, p, x, y, z)
                if not ok or v < -0.5 or v >= p[13] - 0.5 or ((u < -0.5 or u >= p[12] - 0.5) and not wide):
                    continue
                d2 = x * x + y * y + z * z
                distance = math.sqrt(d2)
                cos = -(x * n[0] + y * n[1] + z * n[2]) / distance
                if cos < 0.5 * min_cos:  # the face as a whole passed; its far end may be a little flatter
                    continue
                if mask.shape[0] > 0:
                    column = int(math.floor(u + 0.5)) % int(p[12])
                    if mask[int(math.floor(v + 0.5)), column] == 0:
                        continue
                if not is_visible(depth, model, depth_p, pixel, bias, x, y, z, n[0], n[1], n[2]):
                    continue
                border = min(v + 0.5, p[13] - 0.5 - v)
                if not wide:
                    border = min(border, min(u + 0.5, p[12] - 0.5 - u))
                w = (cos / d2) ** power * (0.02 + 0.98 * min(1.0, border / feather))
                if not is_visible(near, model, depth_p, 3.5 * pixel, bias, x, y, z, n[0], n[1], n[2]):
                    w *= EDGE
                # texels wider than the photo's pixels are sampled from a halved photo
                ratio = size * focal / distance
                level = 0
                while level + 1 < len(photo) and ratio >= 1.6:
                    ratio *= 0.5
                    level += 1
                scale = 0.5**level
                r, g, b = _sample(photo[level], (u + 0.5) * scale - 0.5, (v + 0.5) * scale - 0.5, wide)
                total[ty, tx, 0] += w * r
                total[ty, tx, 1] += w * g
                total[ty, tx, 2] += w * b
                total[ty, tx, 3] += w
                used[i] += 1
    return used.sum()


@njit(cache=True, parallel=True)
def resolve(total, rgb, seen):  # type: ignore[no-untyped-def]
    """Weighted means of `total` (H, W, 4) into `rgb` (H, W, 3) uint8; `seen` (H, W) becomes 255 where there is one."""
    height, width = seen.shape
    for y in prange(height):
        for x in range(width):
            w = total[y, x, 3]
            if w > 0:
                seen[y, x] = 255
                for k in range(3):
                    rgb[y, x, k] = min(255.0, max(0.0, total[y, x, k] / w + 0.5))


@njit(cache=True, parallel=True)
def count(owner, seen, flat):  # type: ignore[no-untyped-def]
    """(F, 4) texels of every face: all, seen by a photo (255), coloured from points (128), filled (64)."""
    height, width = owner.shape
    out = np.zeros((len(flat), 4), np.int64)
    for f in prange(len(flat)):
        x0, y0, x1, y1 = _box(flat, f, width, height)
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                if owner[y, x] == f:
                    out[f, 0] += 1
                    s = seen[y, x]
                    out[f, 1] += s == 255
                    out[f, 2] += s == 128
                    out[f, 3] += s == 64
    return out
