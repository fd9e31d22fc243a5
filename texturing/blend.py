"""Kernels that paint a page: whose texel is it, and what do the photos say of it. Import late: it loads numba.

Texel (x, y) of a page of W x H has its centre at u = (x + 0.5) / W, v = 1 - (y + 0.5) / H.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from scan2sim.pipeline.cameras import ALIKE, EQUIRECTANGULAR, ORTHOGRAPHIC, project_point
from scan2sim.pipeline.range_image import SLOPE_SHARE, slope_of
from scan2sim.pipeline.types import F32, F64, I32, U8
from scan2sim.texturing.photos import OFFSET, Photo

BAND = 32
WHITE = 251.0
EDGE = 0.01
"""Share of its weight that a photo keeps beside something that hides what is behind."""


@dataclass(frozen=True)
class Look:
    """All that a view brings: its photo, camera, pose, and where it may be used.

    Attributes:
        photo: ready to be sampled.
        mask: (h, w) uint8, 0 where it must not be used; (0, 0) for none.
        model, parameters: of the camera.
        depth: range image, of any size.
        near, apart: the least range around every pixel of `depth`, closely and as far as low frequencies reach;
            beside something nearer the photo's own pixels mix both, and its weight falls to `EDGE`.
        reach: pixels of the range image by which `apart` looks around.
        R, t: (3, 3) and (3,), camera from local.
        pixel: radians a pixel of the range image spans (`cameras.pixel_angle`).
        exposure: (5,) of `photos.Exposures.of`.
        warp: (h, w, 2) pixels to be added to where the photo is looked up; (0, 0, 2) for none.
    """

    photo: Photo
    mask: U8
    model: int
    parameters: F64
    depth: F32
    near: F32
    apart: F32
    reach: int
    R: F64
    t: F64
    pixel: float
    exposure: F64
    warp: F32


@dataclass(frozen=True)
class Weighing:
    """How photos are weighed.

    Attributes:
        bias: metres, of the visibility test.
        power: a photo's weight is (cos / distance^2) to this.
        feather: pixels over which the weight fades towards the photo's border.
        min_cos: as in the choice of views.
        band: pixels of the photo that part low frequencies from detail; 0: all is detail; -1: nothing is.
    """

    bias: float
    power: float
    feather: float
    min_cos: float
    band: int


class Rows(Protocol):
    """Rows of a page that photos are added to, one after another."""

    def add(self, faces: npt.NDArray[np.int64], share: F32, look: Look, weighing: Weighing) -> int:
        """Add what one photo says of `faces` (N,); returns the texels that it sees.

        Args:
            faces: indices into the page's faces.
            share: (N, 3) how much of the detail it is to give at the faces' corners, 0 to 1.
            look: the photo.
            weighing: of it.
        """

    def resolve(self, rgb: U8, seen: U8) -> None:
        """Weighted means into `rgb` (H, W, 3); `seen` (H, W) is 255 where there is one."""


class NumbaRows:
    """`Rows` on the processors.

    Args:
        owner: (H, W) the face of each texel, index into the next three; -1 where none.
        flat, corners, normals: (F, 3, 2) texels, (F, 3, 3) metres and (F, 3) unit.
    """

    def __init__(self, owner: I32, flat: F32, corners: F32, normals: F32) -> None:
        self._owner, self._flat, self._corners, self._normals = owner, flat, corners, normals
        self._low, self._detail = (np.zeros((*owner.shape, 4), np.float32) for _ in range(2))

    def add(self, faces: npt.NDArray[np.int64], share: F32, look: Look, weighing: Weighing) -> int:
        """See `Rows`."""
        return int(accumulate(
            self._low, self._detail, self._owner, faces, share, self._flat, self._corners, self._normals,
            look.photo.levels, look.photo.low, look.mask, look.model, look.parameters, look.depth, look.near,
            look.apart, look.reach, look.R, look.t, look.pixel, look.exposure, look.warp, weighing.bias,
            weighing.power, weighing.feather, weighing.min_cos, weighing.band,
        ))  # fmt: skip

    def resolve(self, rgb: U8, seen: U8) -> None:
        """See `Rows`."""
        resolve(self._low, self._detail, rgb, seen)


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
def sample(image, u, v, wrap):  # type: ignore[no-untyped-def]
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


@njit(cache=True, inline="always")
def _cubic(f):  # type: ignore[no-untyped-def]
    """Weights of four neighbours at fraction f between the middle ones (Catmull and Rom)."""
    f2, f3 = f * f, f * f * f
    return (
        -0.5 * f3 + f2 - 0.5 * f,
        1.5 * f3 - 2.5 * f2 + 1,
        -1.5 * f3 + 2 * f2 + 0.5 * f,
        0.5 * f3 - 0.5 * f2,
    )


@njit(cache=True)
def sample_sharp(image, u, v, wrap):  # type: ignore[no-untyped-def]
    """Bicubic colour of a photo (H, W, 3) at a pixel: keeps what bilinear interpolation blurs."""
    height, width = image.shape[0], image.shape[1]
    u0, v0 = math.floor(u), math.floor(v)
    wu, wv = _cubic(u - u0), _cubic(v - v0)
    r = g = b = 0.0
    for j in range(4):
        y = min(max(int(v0) + j - 1, 0), height - 1)
        for i in range(4):
            x = int(u0) + i - 1
            x = x % width if wrap else min(max(x, 0), width - 1)
            w = wu[i] * wv[j]
            r += w * image[y, x, 0]
            g += w * image[y, x, 1]
            b += w * image[y, x, 2]
    return r, g, b


@njit(cache=True, inline="always")
def vignette(exposure, p, u, v):  # type: ignore[no-untyped-def]
    """Factor that undoes the darkening towards a photo's corners; `exposure` as of `photos.Exposures.of`."""
    if exposure[3] == 0.0 and exposure[4] == 0.0:
        return 1.0
    cx, cy = 0.5 * (p[12] - 1), 0.5 * (p[13] - 1)
    q = ((u - cx) ** 2 + (v - cy) ** 2) / (cx * cx + cy * cy)
    return math.exp(exposure[3] * q + exposure[4] * q * q)


@njit(cache=True, inline="always")
def corrected(value, factor):  # type: ignore[no-untyped-def]
    """An encoded grey level whose light is multiplied: `factor` is of the power law's base."""
    return (value + OFFSET) * factor - OFFSET


@njit(cache=True, inline="always")
def mask_allows(mask, u, v, p):  # type: ignore[no-untyped-def]
    """Whether the mask (H, W), of the photo's size or a fraction of it, lets a pixel be used; (0, 0) always does."""
    if mask.shape[0] == 0:
        return True
    column = int((u + 0.5) / p[12] * mask.shape[1]) % mask.shape[1]
    row = min(max(int((v + 0.5) / p[13] * mask.shape[0]), 0), mask.shape[0] - 1)
    return mask[row, column] != 0


@njit(cache=True, inline="always")
def warped(warp, p, u, v, wrap):  # type: ignore[no-untyped-def]
    """Where a photo shows what belongs at pixel (u, v): displaced by `warp`, interpolated."""
    height, width = warp.shape[0], warp.shape[1]
    x, y = (u + 0.5) * width / p[12] - 0.5, (v + 0.5) * height / p[13] - 0.5
    x0, y0 = math.floor(x), math.floor(y)
    fx, fy = x - x0, y - y0
    a, b = int(x0), int(x0) + 1
    if wrap:
        a, b = a % width, b % width
    else:
        a, b = min(max(a, 0), width - 1), min(max(b, 0), width - 1)
    c, d = min(max(int(y0), 0), height - 1), min(max(int(y0) + 1, 0), height - 1)
    w00, w01, w10, w11 = (1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy
    du = warp[c, a, 0] * w00 + warp[c, b, 0] * w01 + warp[d, a, 0] * w10 + warp[d, b, 0] * w11
    dv = warp[c, a, 1] * w00 + warp[c, b, 1] * w01 + warp[d, a, 1] * w10 + warp[d, b, 1] * w11
    return u + du, v + dv


@njit(cache=True, parallel=True)
def accumulate(  # type: ignore[no-untyped-def]
    low_sum, detail_sum, owner, faces, share, flat, corners, normals, photo, low, mask, model, p, depth, near, apart,
    reach, R, t, pixel, exposure, warp, bias, power, feather, min_cos, band,
):  # fmt: skip
    """`NumbaRows.add`: see `Look` and `Weighing`.

    Args:
        low_sum, detail_sum: (H, W, 4) float32, sums of weight times colour, and of weights, of low frequencies and
            of what is finer; changed in place.
    """
    height, width = owner.shape
    wide, parallel = model == EQUIRECTANGULAR, model == ORTHOGRAPHIC
    focal = p[12] / (2 * math.pi) if wide else min(p[0], p[1])
    alike = ALIKE / focal
    factors = (math.exp(exposure[0]), math.exp(exposure[1]), math.exp(exposure[2]))
    coarse_x, coarse_y = low.shape[1] / p[12], low.shape[0] / p[13]
    fine_x, fine_y = depth.shape[1] / p[12], depth.shape[0] / p[13]
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
        ax, ay = flat[f, 0, 0], flat[f, 0, 1]
        bx, by = flat[f, 1, 0] - ax, flat[f, 1, 1] - ay
        cx, cy = flat[f, 2, 0] - ax, flat[f, 2, 1] - ay
        det = bx * cy - by * cx
        chosen = share[i, 0] + share[i, 1] + share[i, 2] > 0
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
                if parallel:  # how far away it is says nothing of how large its pixels are
                    d2, distance, far, cos = alike * alike, z, 1.0, -n[2]
                else:
                    d2 = x * x + y * y + z * z
                    distance = math.sqrt(d2)
                    far = distance
                    cos = -(x * n[0] + y * n[1] + z * n[2]) / distance
                if cos < 0.5 * min_cos:  # the face as a whole passed; its far end may be a little flatter
                    continue
                if not mask_allows(mask, u, v, p):
                    continue
                # as `is_visible`, with the projection at hand
                column = min(max(int((u + 0.5) * fine_x), 0), depth.shape[1] - 1)
                row = min(max(int((v + 0.5) * fine_y), 0), depth.shape[0] - 1)
                lean = slope_of(cos) * far * pixel
                if distance > depth[row, column] + bias + SLOPE_SHARE * lean:
                    continue
                border = min(v + 0.5, p[13] - 0.5 - v)
                if not wide:
                    border = min(border, min(u + 0.5, p[12] - 0.5 - u))
                whole = (cos * cos / d2) ** power * (0.02 + 0.98 * min(1.0, border / feather))
                w = whole
                if distance > apart[row, column] + bias + (reach + 0.5) * lean:
                    w *= EDGE
                fall = vignette(exposure, p, u, v)
                if warp.shape[0] > 0:
                    u, v = warped(warp, p, u, v, wide)
                # texels wider than the photo's pixels are sampled from a halved photo
                ratio = size * focal / far
                level = 0
                while level + 1 < len(photo) and ratio >= 1.6:
                    ratio *= 0.5
                    level += 1
                scale = 0.5**level
                if level == 0 and (chosen or band < 0):
                    r, g, b = sample_sharp(photo[0], u, v, wide)
                else:
                    r, g, b = sample(photo[level], (u + 0.5) * scale - 0.5, (v + 0.5) * scale - 0.5, wide)
                if max(r, max(g, b)) > WHITE:  # overexposed: how bright it is, others know better
                    whole *= EDGE
                    w *= EDGE
                if band < 0:
                    lr, lg, lb = r, g, b
                elif band > 0:
                    lr, lg, lb = sample(low, (u + 0.5) * coarse_x - 0.5, (v + 0.5) * coarse_y - 0.5, wide)
                else:
                    lr = lg = lb = 0.0
                low_sum[ty, tx, 3] += w
                used[i] += 1
                # detail: the chosen photo's; where it can't see a texel, that of the best others
                d = 1e-4 * whole
                if chosen:
                    s = ((tx - ax) * cy - (ty - ay) * cx) / det
                    q = (bx * (ty - ay) - by * (tx - ax)) / det
                    d += max(0.0, share[i, 0] * (1 - s - q) + share[i, 1] * s + share[i, 2] * q)
                if distance > near[row, column] + bias + 1.5 * lean:
                    d *= EDGE
                detail_sum[ty, tx, 3] += d
                for k in range(3):
                    value, coarse = (r, lr) if k == 0 else ((g, lg) if k == 1 else (b, lb))
                    factor = factors[k] * fall
                    base = corrected(coarse, factor) if band != 0 else 0.0
                    low_sum[ty, tx, k] += w * base
                    detail_sum[ty, tx, k] += d * (corrected(value, factor) - base)
    return used.sum()


@njit(cache=True, parallel=True)
def resolve(low_sum, detail_sum, rgb, seen):  # type: ignore[no-untyped-def]
    """Weighted means of both sums (H, W, 4), added, into `rgb` (H, W, 3) uint8; `seen` is 255 where there is one."""
    height, width = seen.shape
    for y in prange(height):
        for x in range(width):
            w, d = low_sum[y, x, 3], detail_sum[y, x, 3]
            if w > 0:
                seen[y, x] = 255
                for k in range(3):
                    value = low_sum[y, x, k] / w + (detail_sum[y, x, k] / d if d > 0 else 0.0)
                    rgb[y, x, k] = min(255.0, max(0.0, value + 0.5))


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
