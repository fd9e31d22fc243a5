"""CPU kernels of the two-band blending of photos into the texels of a page. Import late: it loads numba."""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

import numpy as np
from numba import njit, prange

from scan2sim.pipeline.camera.image_sampling import allows, bicubic, mip_level, mixed, read, rescaled, taps
from scan2sim.pipeline.camera.models import EQUIRECTANGULAR, ORTHO_EQUIVALENT_FOCAL_PX, ORTHOGRAPHIC
from scan2sim.pipeline.camera.projection import (
    SLOPE_BIAS_FACTOR,
    PosedCamera,
    incidence,
    is_occluded,
    pixel_of,
    range_pixel,
    rotate_to_camera,
    to_camera,
)
from scan2sim.pipeline.core.types import F32, F64, I32, I64, U8
from scan2sim.texturing.exposure_model import compressed, corrected, overexposed_weight, vignette
from scan2sim.texturing.texel_map import box, frame

OVEREXPOSED_LEVEL = 251.0
"""Grey level above which a sample counts as overexposed."""
UNRELIABLE_WEIGHT = 0.01
"""Factor on a photo's weight beside depth edges (occlusion)."""


class PhotoData(NamedTuple):
    """A photo as sampled by the kernels.

    Attributes:
        full, half, quarter: image pyramid, (h, w, 3) uint8 each.
        low: (h, w, 3) uint8 low frequencies, of any size.
        mask: (h, w) uint8, 0 where the photo must not be used; (0, 0): no mask.
        warp: (h, w, 2) displacement in pixels, added to sampling positions; (0, 0, 2): no warp.
        exposure: (5,) from `photo_cache.Exposures.of`.
    """

    full: U8
    half: U8
    quarter: U8
    low: U8
    mask: U8
    warp: F32
    exposure: F64


class Occlusion(NamedTuple):
    """Range image of a view, for the visibility test.

    Attributes:
        first, pixel: as in `projection.Ranges`.
        near, around: smallest range around every pixel of `first`: within one pixel, and within `radius` pixels, the
            extent of the low frequencies. Beside a nearer surface the photo's pixels mix both surfaces, and its weight
            is reduced by `UNRELIABLE_WEIGHT`.
        radius: pixels of the range image within which `around` is the smallest range.
    """

    first: F32
    pixel: float
    near: F32
    around: F32
    radius: int


class BlendSource(NamedTuple):
    """A view to be blended: its photo, its posed camera and its range image."""

    photo: PhotoData
    camera: PosedCamera
    occlusion: Occlusion


class BlendSettings(NamedTuple):
    """Settings of the photos' weights.

    Attributes:
        bias: tolerance of the visibility test in metres.
        power: exponent of a photo's weight: (cos / distance^2) ^ power.
        feather: pixels over which the weight fades towards the photo's border.
        min_cos: as in the view selection.
        band: wavelength in pixels of the photo that separates low frequencies from detail; 0: everything is detail;
            -1: no detail, a plain blend.
    """

    bias: float
    power: float
    feather: float
    min_cos: float
    band: int


class PageFaces(NamedTuple):
    """Faces on a page, or on some rows of it.

    Attributes:
        owner: (H, W) face of each texel, index into the other arrays; -1 where there is none.
        flat: (F, 3, 2) corners on the page, texels.
        corners: (F, 3, 3) corners in space, metres.
        normals: (F, 3) unit normals.
    """

    owner: I32
    flat: F32
    corners: F32
    normals: F32


class Sums(NamedTuple):
    """Accumulated samples: (H, W, 4) float32 sums of weight times colour (3 channels) and of weights.

    Attributes:
        low: sums of the low frequencies.
        detail: sums of the detail.
    """

    low: F32
    detail: F32


class RowBlender(Protocol):
    """Blends photos into rows of a page, one photo after another."""

    def add(self, faces: I64, share: F32, source: BlendSource, settings: BlendSettings) -> int:
        """Add one photo for `faces` (N,); returns the number of texels that it sees.

        Args:
            faces: indices into the page's faces.
            share: (N, 3) share of the detail that the photo gives at the faces' corners, 0 to 1.
            source: the photo, its camera and its range image.
            settings: settings of its weights.
        """

    def resolve(self, rgb: U8, seen: U8, white: float) -> None:
        """Write weighted means into `rgb` (H, W, 3), and 255 into `seen` (H, W) where there is one.

        `white` is the white point of the tone curve, `photo_cache.Exposures.white`.
        """


class NumbaRowBlender:
    """`RowBlender` on the CPU."""

    def __init__(self, page_faces: PageFaces) -> None:
        self._page_faces = page_faces
        self._sums = Sums(*(np.zeros((*page_faces.owner.shape, 4), np.float32) for _ in range(2)))

    def add(self, faces: I64, share: F32, source: BlendSource, settings: BlendSettings) -> int:
        """See `RowBlender`."""
        return int(accumulate(self._sums, self._page_faces, faces, share, *source, settings))

    def resolve(self, rgb: U8, seen: U8, white: float) -> None:
        """See `RowBlender`."""
        resolve(self._sums, rgb, seen, white)


@njit(cache=True, parallel=True, error_model="numpy")
def accumulate(
    sums: Sums,
    page_faces: PageFaces,
    faces: I64,
    share: F32,
    photo: PhotoData,
    camera: PosedCamera,
    occlusion: Occlusion,
    settings: BlendSettings,
) -> int:
    """Kernel of `RowBlender.add`: adds to `sums` in place. `tests/texturing/reference_blend.py` is its reference."""
    used = np.zeros(len(faces), np.int64)
    for i in prange(len(faces)):
        used[i] = _add_face(sums, page_faces, faces[i], share[i], photo, camera, occlusion, settings)
    return used.sum()


@njit(cache=True, error_model="numpy")
def _add_face(
    sums: Sums,
    page_faces: PageFaces,
    f: int,
    share: F32,
    photo: PhotoData,
    camera: PosedCamera,
    occlusion: Occlusion,
    settings: BlendSettings,
) -> int:
    """Add a photo to face f, with its `share` (3,) of the detail at the face's corners; returns the texels seen."""
    origin, per_x, per_y, ok = frame(page_faces.flat, page_faces.corners, f)
    if not ok:
        return 0
    # local variables: attribute access to the tuples makes the loops a third slower
    owner, low_sum, detail_sum = page_faces.owner, sums.low, sums.detail
    full, half, quarter, coarser, mask, warp, exposure = photo
    first, _, near, around, radius = occlusion
    p, wrap, bias, band = camera.p, camera.model == EQUIRECTANGULAR, settings.bias, settings.band
    n = rotate_to_camera(camera.T, page_faces.normals[f, 0], page_faces.normals[f, 1], page_faces.normals[f, 2])
    o = to_camera(camera.T, origin[0], origin[1], origin[2])
    dx, dy = (
        rotate_to_camera(camera.T, per_x[0], per_x[1], per_x[2]),
        rotate_to_camera(camera.T, per_y[0], per_y[1], per_y[2]),
    )
    parallel = camera.model == ORTHOGRAPHIC  # the ground sample distance doesn't depend on the distance
    focal = p[12] / (2 * math.pi) if wrap else min(p[0], p[1])
    wanted = focal * math.sqrt(max(dx[0] ** 2 + dx[1] ** 2 + dx[2] ** 2, dy[0] ** 2 + dy[1] ** 2 + dy[2] ** 2))
    factors = (math.exp(exposure[0]), math.exp(exposure[1]), math.exp(exposure[2]))
    overexposed_factor = overexposed_weight(exposure)
    chosen = share[0] + share[1] + share[2] > 0
    used = 0
    x0, y0, x1, y1 = box(page_faces.flat, f, owner.shape[1], owner.shape[0])
    for ty in range(y0, y1 + 1):
        for tx in range(x0, x1 + 1):
            if owner[ty, tx] != f:
                continue
            x, y, z = o[0] + tx * dx[0] + ty * dy[0], o[1] + tx * dx[1] + ty * dy[1], o[2] + tx * dx[2] + ty * dy[2]
            u, v, ok = pixel_of(camera, x, y, z)
            if not ok or not allows(mask, p, u, v):
                continue
            r, cos = incidence(camera, x, y, z, n[0], n[1], n[2])
            if cos < 0.5 * settings.min_cos:  # min_cos was checked for the face as a whole; texels may be lower
                continue
            row, column, lean = range_pixel(camera, occlusion, u, v, r, cos)
            if is_occluded(r, first[row, column], lean, SLOPE_BIAS_FACTOR, bias):
                continue
            used += 1
            s, t = _warped(warp, p, u, v, wrap)
            rgb = _colour(full, half, quarter, p, s, t, wrap, wanted if parallel else wanted / r, chosen or band < 0)
            weight = (cos * cos / (ORTHO_EQUIVALENT_FOCAL_PX / focal if parallel else r) ** 2) ** settings.power
            weight *= 0.02 + 0.98 * min(1.0, _border_distance(camera, u, v) / settings.feather)
            if max(rgb) > OVEREXPOSED_LEVEL:
                weight *= overexposed_factor
            beside_edge = is_occluded(r, around[row, column], lean, radius + 0.5, bias)
            low = weight * UNRELIABLE_WEIGHT if beside_edge else weight
            # detail comes from the selected photo; where it can't see a texel, from the best others
            detail = 1e-4 * weight + (_share_at(page_faces.flat, f, share, tx, ty) if chosen else 0.0)
            if is_occluded(r, near[row, column], lean, 1.5, bias):
                detail *= UNRELIABLE_WEIGHT
            vignetting_factor = vignette(exposure, p, u, v)
            coarse = rgb if band < 0 else read(coarser, p, s, t, wrap)
            low_sum[ty, tx, 3] += low
            detail_sum[ty, tx, 3] += detail
            for k in range(3):
                factor = factors[k] * vignetting_factor
                base = corrected(coarse[k], factor) if band != 0 else 0.0
                low_sum[ty, tx, k] += low * base
                detail_sum[ty, tx, k] += detail * (corrected(rgb[k], factor) - base)
    return used


@njit(cache=True, inline="always")
def _border_distance(camera: PosedCamera, u: float, v: float) -> float:
    """Pixels to the nearest border of the photo; the sides of a panorama are not borders."""
    border = min(v + 0.5, camera.p[13] - 0.5 - v)
    return border if camera.model == EQUIRECTANGULAR else min(border, min(u + 0.5, camera.p[12] - 0.5 - u))


@njit(cache=True, inline="always")
def _warped(warp: F32, p: F64, u: float, v: float, wrap: bool) -> tuple[float, float]:
    """A pixel position displaced by the photo's warp."""
    if warp.shape[0] == 0:
        return u, v
    x, y = rescaled(p, u, v, warp)
    at = taps(warp, x, y, wrap)
    return u + mixed(warp, 0, at), v + mixed(warp, 1, at)


@njit(cache=True, inline="always")
def _colour(
    full: U8, half: U8, quarter: U8, p: F64, u: float, v: float, wrap: bool, wide: float, sharp: bool
) -> tuple[float, float, float]:
    """(r, g, b) of a photo at a pixel for a texel `wide` pixels wide; bicubic at full resolution if `sharp`."""
    level = mip_level(wide, 3)
    if level == 0 and sharp:
        return bicubic(full, u, v, wrap)
    if level == 0:
        return read(full, p, u, v, wrap)
    if level == 1:
        return read(half, p, u, v, wrap)
    return read(quarter, p, u, v, wrap)


@njit(cache=True, inline="always")
def _share_at(flat: F32, f: int, share: F32, x: float, y: float) -> float:
    """Share at a texel of face f, interpolated from its corners' shares (3,)."""
    ax, ay = flat[f, 0, 0], flat[f, 0, 1]
    bx, by = flat[f, 1, 0] - ax, flat[f, 1, 1] - ay
    cx, cy = flat[f, 2, 0] - ax, flat[f, 2, 1] - ay
    det = bx * cy - by * cx
    s, t = ((x - ax) * cy - (y - ay) * cx) / det, (bx * (y - ay) - by * (x - ax)) / det
    return max(0.0, share[0] * (1 - s - t) + share[1] * s + share[2] * t)


@njit(cache=True, parallel=True)
def resolve(sums: Sums, rgb: U8, seen: U8, white: float) -> None:
    """Write low frequencies plus detail (weighted means) into `rgb` (H, W, 3) uint8; `seen` is 255 where defined.

    `white` is the white point of the tone curve.
    """
    height, width = seen.shape
    for y in prange(height):
        for x in range(width):
            w, d = sums.low[y, x, 3], sums.detail[y, x, 3]
            if w > 0:
                seen[y, x] = 255
                for k in range(3):
                    value = sums.low[y, x, k] / w + (sums.detail[y, x, k] / d if d > 0 else 0.0)
                    rgb[y, x, k] = min(255.0, max(0.0, compressed(value, white) + 0.5))
