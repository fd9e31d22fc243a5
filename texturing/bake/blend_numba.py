"""Kernels that bake a page: what photos say of its texels, weighed and summed. Import late: it loads numba."""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

import numpy as np
from numba import njit, prange

from scan2sim.pipeline.camera.image_sampling import allows, bicubic, halving, mixed, read, rescaled, taps
from scan2sim.pipeline.camera.models import ALIKE, EQUIRECTANGULAR, ORTHOGRAPHIC
from scan2sim.pipeline.camera.projection import (
    SLOPE_SHARE,
    Eye,
    incidence,
    is_behind,
    pixel_of,
    range_pixel,
    to_camera,
    turned,
)
from scan2sim.pipeline.core.types import F32, F64, I32, I64, U8
from scan2sim.texturing.bake.texel_map import box, frame
from scan2sim.texturing.photo_cache import OFFSET

WHITE = 251.0
EDGE = 0.01
"""Share of its weight that a photo keeps beside something that hides what is behind."""


class Picture(NamedTuple):
    """A photo as kernels sample it.

    Attributes:
        whole, half, quarter: (h, w, 3) uint8: the photo, halved, and halved again.
        low: its low frequencies, of any size.
        mask: (h, w) uint8, 0 where it must not be used; (0, 0) for none.
        warp: (h, w, 2) pixels to be added to where it is sampled; (0, 0, 2) for none.
        exposure: (5,) of `photos.Exposures.of`.
    """

    whole: U8
    half: U8
    quarter: U8
    low: U8
    mask: U8
    warp: F32
    exposure: F64


class Occlusion(NamedTuple):
    """What a photo's view sees first, as `projection.Ranges`, and around it.

    Attributes:
        first, pixel: of `projection.Ranges`.
        near, apart: the least range around every pixel of `first`, closely and as far as low frequencies reach;
            beside something nearer the photo's own pixels mix both, and its weight falls to `EDGE`.
        reach: pixels of the range image around which `apart` was taken.
    """

    first: F32
    pixel: float
    near: F32
    apart: F32
    reach: int


class Source(NamedTuple):
    """All that a view brings: its picture, its camera and pose, and what hides."""

    picture: Picture
    eye: Eye
    occlusion: Occlusion


class Weighing(NamedTuple):
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


class Laid(NamedTuple):
    """Faces laid on (rows of) a page.

    Attributes:
        owner: (H, W) the face of each texel, index into the next three; -1 where none.
        flat, corners, normals: (F, 3, 2) texels, (F, 3, 3) metres and (F, 3) unit.
    """

    owner: I32
    flat: F32
    corners: F32
    normals: F32


class Sums(NamedTuple):
    """What photos have said: (H, W, 4) float32 sums of weight times colour, and of weights.

    Attributes:
        low: of low frequencies.
        detail: of what is finer.
    """

    low: F32
    detail: F32


class Rows(Protocol):
    """Rows of a page that photos are added to, one after another."""

    def add(self, faces: I64, share: F32, source: Source, weighing: Weighing) -> int:
        """Add what one photo says of `faces` (N,); returns the texels that it sees.

        Args:
            faces: indices into the page's faces.
            share: (N, 3) how much of the detail it is to give at the faces' corners, 0 to 1.
            source: the photo.
            weighing: of it.
        """

    def resolve(self, rgb: U8, seen: U8) -> None:
        """Weighted means into `rgb` (H, W, 3); `seen` (H, W) is 255 where there is one."""


class NumbaRows:
    """`Rows` on the processors."""

    def __init__(self, laid: Laid) -> None:
        self._laid = laid
        self._sums = Sums(*(np.zeros((*laid.owner.shape, 4), np.float32) for _ in range(2)))

    def add(self, faces: I64, share: F32, source: Source, weighing: Weighing) -> int:
        """See `Rows`."""
        return int(accumulate(self._sums, self._laid, faces, share, *source, weighing))

    def resolve(self, rgb: U8, seen: U8) -> None:
        """See `Rows`."""
        resolve(self._sums, rgb, seen)


@njit(cache=True, inline="always")
def vignette(exposure: F64, p: F64, u: float, v: float) -> float:
    """Factor that undoes the darkening towards a photo's corners; `exposure` as of `photos.Exposures.of`."""
    if exposure[3] == 0.0 and exposure[4] == 0.0:
        return 1.0
    cx, cy = 0.5 * (p[12] - 1), 0.5 * (p[13] - 1)
    q = ((u - cx) ** 2 + (v - cy) ** 2) / (cx * cx + cy * cy)
    return math.exp(exposure[3] * q + exposure[4] * q * q)


@njit(cache=True, inline="always")
def corrected(value: float, factor: float) -> float:
    """An encoded grey level whose light is multiplied: `factor` is of the power law's base."""
    return (value + OFFSET) * factor - OFFSET


@njit(cache=True, parallel=True)
def accumulate(
    sums: Sums, laid: Laid, faces: I64, share: F32, picture: Picture, eye: Eye, occlusion: Occlusion, weighing: Weighing
) -> int:
    """`Rows.add` to `sums`, in place; `tests/texturing/reference_blend.py` says the same without haste."""
    used = np.zeros(len(faces), np.int64)
    for i in prange(len(faces)):
        used[i] = _add_face(sums, laid, faces[i], share[i], picture, eye, occlusion, weighing)
    return used.sum()


@njit(cache=True)
def _add_face(
    sums: Sums, laid: Laid, f: int, share: F32, picture: Picture, eye: Eye, occlusion: Occlusion, weighing: Weighing
) -> int:
    """Add what a photo says of face f, whose corners want `share` (3,) of their detail from it; the texels seen."""
    origin, per_x, per_y, ok = frame(laid.flat, laid.corners, f)
    if not ok:
        return 0
    # arrays by themselves: over tuples of them, the loops take a third longer
    owner, low_sum, detail_sum = laid.owner, sums.low, sums.detail
    whole, half, quarter, coarser, mask, warp, exposure = picture
    first, _, near, apart, reach = occlusion
    p, wrap, bias, band = eye.p, eye.model == EQUIRECTANGULAR, weighing.bias, weighing.band
    n = turned(eye.T, laid.normals[f, 0], laid.normals[f, 1], laid.normals[f, 2])
    o = to_camera(eye.T, origin[0], origin[1], origin[2])
    dx, dy = turned(eye.T, per_x[0], per_x[1], per_x[2]), turned(eye.T, per_y[0], per_y[1], per_y[2])
    parallel = eye.model == ORTHOGRAPHIC  # how far away it is says nothing of how large its pixels are
    focal = p[12] / (2 * math.pi) if wrap else min(p[0], p[1])
    wanted = focal * math.sqrt(max(dx[0] ** 2 + dx[1] ** 2 + dx[2] ** 2, dy[0] ** 2 + dy[1] ** 2 + dy[2] ** 2))
    factors = (math.exp(exposure[0]), math.exp(exposure[1]), math.exp(exposure[2]))
    chosen = share[0] + share[1] + share[2] > 0
    used = 0
    x0, y0, x1, y1 = box(laid.flat, f, owner.shape[1], owner.shape[0])
    for ty in range(y0, y1 + 1):
        for tx in range(x0, x1 + 1):
            if owner[ty, tx] != f:
                continue
            x, y, z = o[0] + tx * dx[0] + ty * dy[0], o[1] + tx * dx[1] + ty * dy[1], o[2] + tx * dx[2] + ty * dy[2]
            u, v, ok = pixel_of(eye, x, y, z)
            if not ok or not allows(mask, p, u, v):
                continue
            r, cos = incidence(eye, x, y, z, n[0], n[1], n[2])
            if cos < 0.5 * weighing.min_cos:  # the face as a whole passed; its far end may be a little flatter
                continue
            row, column, lean = range_pixel(eye, occlusion, u, v, r, cos)
            if is_behind(r, first[row, column], lean, SLOPE_SHARE, bias):
                continue
            used += 1
            s, t = _displaced(warp, p, u, v, wrap)
            rgb = _colour(whole, half, quarter, p, s, t, wrap, wanted if parallel else wanted / r, chosen or band < 0)
            worth = (cos * cos / (ALIKE / focal if parallel else r) ** 2) ** weighing.power
            worth *= 0.02 + 0.98 * min(1.0, _border(eye, u, v) / weighing.feather)
            if max(rgb) > WHITE:  # overexposed: how bright it is, others know better
                worth *= EDGE
            low = worth * EDGE if is_behind(r, apart[row, column], lean, reach + 0.5, bias) else worth
            # detail: the chosen photo's; where it can't see a texel, that of the best others
            detail = 1e-4 * worth + (_share_at(laid.flat, f, share, tx, ty) if chosen else 0.0)
            if is_behind(r, near[row, column], lean, 1.5, bias):
                detail *= EDGE
            fall = vignette(exposure, p, u, v)
            coarse = rgb if band < 0 else read(coarser, p, s, t, wrap)
            low_sum[ty, tx, 3] += low
            detail_sum[ty, tx, 3] += detail
            for k in range(3):
                factor = factors[k] * fall
                base = corrected(coarse[k], factor) if band != 0 else 0.0
                low_sum[ty, tx, k] += low * base
                detail_sum[ty, tx, k] += detail * (corrected(rgb[k], factor) - base)
    return used


@njit(cache=True, inline="always")
def _border(eye: Eye, u: float, v: float) -> float:
    """Pixels to the nearest border of the photo; a panorama's sides are none."""
    border = min(v + 0.5, eye.p[13] - 0.5 - v)
    return border if eye.model == EQUIRECTANGULAR else min(border, min(u + 0.5, eye.p[12] - 0.5 - u))


@njit(cache=True, inline="always")
def _displaced(warp: F32, p: F64, u: float, v: float, wrap: bool) -> tuple[float, float]:
    """Where a photo shows what belongs at a pixel."""
    if warp.shape[0] == 0:
        return u, v
    x, y = rescaled(p, u, v, warp)
    at = taps(warp, x, y, wrap)
    return u + mixed(warp, 0, at), v + mixed(warp, 1, at)


@njit(cache=True, inline="always")
def _colour(
    whole: U8, half: U8, quarter: U8, p: F64, u: float, v: float, wrap: bool, wide: float, sharp: bool
) -> tuple[float, float, float]:
    """(r, g, b) of a photo at a pixel, for a texel that is `wide` pixels wide; sampled sharply where asked."""
    level = halving(wide, 3)
    if level == 0 and sharp:
        return bicubic(whole, u, v, wrap)
    if level == 0:
        return read(whole, p, u, v, wrap)
    if level == 1:
        return read(half, p, u, v, wrap)
    return read(quarter, p, u, v, wrap)


@njit(cache=True, inline="always")
def _share_at(flat: F32, f: int, share: F32, x: float, y: float) -> float:
    """The corners' shares (3,), interpolated at a texel of face f."""
    ax, ay = flat[f, 0, 0], flat[f, 0, 1]
    bx, by = flat[f, 1, 0] - ax, flat[f, 1, 1] - ay
    cx, cy = flat[f, 2, 0] - ax, flat[f, 2, 1] - ay
    det = bx * cy - by * cx
    s, t = ((x - ax) * cy - (y - ay) * cx) / det, (bx * (y - ay) - by * (x - ax)) / det
    return max(0.0, share[0] * (1 - s - t) + share[1] * s + share[2] * t)


@njit(cache=True, parallel=True)
def resolve(sums: Sums, rgb: U8, seen: U8) -> None:
    """Weighted means of both sums, added, into `rgb` (H, W, 3) uint8; `seen` is 255 where there is one."""
    height, width = seen.shape
    for y in prange(height):
        for x in range(width):
            w, d = sums.low[y, x, 3], sums.detail[y, x, 3]
            if w > 0:
                seen[y, x] = 255
                for k in range(3):
                    value = sums.low[y, x, k] / w + (sums.detail[y, x, k] / d if d > 0 else 0.0)
                    rgb[y, x, k] = min(255.0, max(0.0, value + 0.5))
