"""Patch alignment: registers a template of each feature, taken where it was detected, with every new image (no drift).

Tracking from frame to frame alone accumulates the errors of all frames. Here the tracked position is refined by
aligning the template: translation, affine shape, gain and offset, by Gauss-Newton with the template's gradients
(inverse compositional: Baker and Matthews, "Lucas-Kanade 20 years on", IJCV 2004), starting at the tracked position
with the affine shape of the previous frame (Shi and Tomasi, "Good features to track", CVPR 1994). Uses numba: import
it late.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numba import njit

from scan2sim.pipeline.core.types import F32, F64, I32, I64, U8, Bools

PATCH_RADIUS_PX = 5
"""From a patch's centre to its edge; one more pixel is stored around it, for gradients."""
WEIGHT_SIGMA_PX = 3.0
"""Standard deviation of the Gaussian weight around the feature: the surroundings may move differently."""
ITERATIONS_MAX, STEP_MIN_PX = 10, 0.01
"""Gauss-Newton stops after this number of iterations, or at a smaller step."""
CORRELATION_MIN = 0.9
"""Normalized cross-correlation with the template below which a feature is lost."""
SHIFT_MAX_PX = 1.5
"""Distance between tracked and aligned position beyond which a feature is lost."""
STRETCH_MAX = 1.6
"""A template that is enlarged, shrunk or sheared by more is replaced: at another scale, it shows other details."""

PATCH_SIDE = 2 * PATCH_RADIUS_PX + 3
"""Pixels, with the border for gradients."""


@dataclass
class Patches:
    """Templates of features.

    Attributes:
        ids: (N,) ids of the tracks, ascending.
        view: (N,) virtual view in which each is aligned.
        template: (N, PATCH_SIDE, PATCH_SIDE) grey values.
        offset: (N, 2) pixels from the template's centre to the feature, at most half a pixel.
        shape: (N, 2, 2) affine transform from offsets in the template to offsets in the last image.
    """

    ids: I64 = field(default_factory=lambda: np.zeros(0, np.int64))
    view: I32 = field(default_factory=lambda: np.zeros(0, np.int32))
    template: U8 = field(default_factory=lambda: np.zeros((0, PATCH_SIDE, PATCH_SIDE), np.uint8))
    offset: F64 = field(default_factory=lambda: np.zeros((0, 2)))
    shape: F64 = field(default_factory=lambda: np.zeros((0, 2, 2)))

    def find(self, ids: I64) -> tuple[I64, Bools]:
        """(N,) rows of ids, and whether each id is present."""
        if not len(self.ids):
            return np.zeros(len(ids), np.int64), np.zeros(len(ids), bool)
        rows = np.minimum(np.searchsorted(self.ids, ids), len(self.ids) - 1)
        return rows, self.ids[rows] == ids

    def keep(self, ids: I64) -> None:
        """Remove all templates but those of `ids`."""
        mask = np.isin(self.ids, ids)
        self.ids, self.view, self.template = self.ids[mask], self.view[mask], self.template[mask]
        self.offset, self.shape = self.offset[mask], self.shape[mask]

    def capture(self, ids: I64, view: int, image: U8, uv: F32 | F64) -> None:
        """Add or replace the templates of features at pixels (N, 2) of a virtual view's image."""
        self.keep(self.ids[~np.isin(self.ids, ids)])
        uv = np.asarray(uv, np.float64)
        centre: F64 = np.round(uv)
        template = _cut_out(image, centre.astype(np.int64))
        order = np.argsort(np.concatenate([self.ids, ids]), kind="stable")
        self.ids = np.concatenate([self.ids, ids])[order]
        self.view = np.concatenate([self.view, np.full(len(ids), view, np.int32)])[order]
        self.template = np.concatenate([self.template, template])[order]
        self.offset = np.concatenate([self.offset, uv - centre])[order]
        self.shape = np.concatenate([self.shape, np.tile(np.eye(2), (len(ids), 1, 1))])[order]

    def align(self, ids: I64, view: int, image: U8, uv: F32) -> F64:
        """Aligned pixels (N, 2) of known features tracked to pixels `uv` (N, 2); NaN where a template doesn't match."""
        height, width = image.shape
        rows, _ = self.find(ids)
        inside = np.asarray(((uv > 0) & (uv < (width - 1, height - 1))).all(axis=1))  # False for NaN
        start = np.where(inside[:, None], uv, 0.0)
        aligned, shape, correlation = _aligned(image, self.template[rows], self.offset[rows], self.shape[rows], start)
        good = inside & (correlation > CORRELATION_MIN) & (np.linalg.norm(aligned - start, axis=1) < SHIFT_MAX_PX)
        self.shape[rows[good]] = shape[good]
        stretch = np.linalg.svd(shape, compute_uv=False)
        outdated = good & ((stretch[:, 0] > STRETCH_MAX) | (stretch[:, 1] < 1 / STRETCH_MAX))
        if outdated.any():
            self.capture(ids[outdated], view, image, aligned[outdated])
        aligned[~good] = np.nan
        return aligned


@njit(cache=True, nogil=True)
def _cut_out(image: U8, centre: I64) -> U8:
    """(N, PATCH_SIDE, PATCH_SIDE) patches around pixels (N, 2); edge pixels are repeated outside the image."""
    height, width = image.shape
    out = np.empty((len(centre), PATCH_SIDE, PATCH_SIDE), np.uint8)
    for n in range(len(centre)):
        for i in range(PATCH_SIDE):
            row = min(max(centre[n, 1] + i - PATCH_SIDE // 2, 0), height - 1)
            for j in range(PATCH_SIDE):
                out[n, i, j] = image[row, min(max(centre[n, 0] + j - PATCH_SIDE // 2, 0), width - 1)]
    return out


@njit(cache=True, inline="always")
def _bilinear(image: U8, x: float, y: float) -> float:
    """Grey value at subpixel coordinates, by bilinear interpolation."""
    height, width = image.shape
    x, y = min(max(x, 0.0), width - 1.001), min(max(y, 0.0), height - 1.001)
    c, r = int(x), int(y)
    a, b = x - c, y - r
    above = (1 - a) * image[r, c] + a * image[r, c + 1]
    return float((1 - b) * above + b * ((1 - a) * image[r + 1, c] + a * image[r + 1, c + 1]))


@njit(cache=True, nogil=True)
def _gradients(template: U8, offset: F64, weight: F64, T: F64, J: F64) -> float:
    """Fill a template's mean-free values T (K,), their Jacobian J (K, 6) by the affine parameters, and weights (K,).

    J is made orthogonal to gain and offset. Returns the weighted sum of squares of T.
    """
    k, total, mean = 0, 0.0, 0.0
    for i in range(1, PATCH_SIDE - 1):
        for j in range(1, PATCH_SIDE - 1):
            x, y = j - PATCH_SIDE // 2 - offset[0], i - PATCH_SIDE // 2 - offset[1]
            w = math.exp(-(x * x + y * y) / (2 * WEIGHT_SIGMA_PX * WEIGHT_SIGMA_PX))
            gx = (float(template[i, j + 1]) - float(template[i, j - 1])) / 2
            gy = (float(template[i + 1, j]) - float(template[i - 1, j])) / 2
            J[k, 0], J[k, 1], J[k, 2], J[k, 3], J[k, 4], J[k, 5] = gx, gy, gx * x, gx * y, gy * x, gy * y
            weight[k], T[k] = w, template[i, j]
            total += w
            mean += w * T[k]
            k += 1
    squares = 0.0
    for k in range(len(T)):
        weight[k] /= total
        T[k] -= mean / total
        squares += weight[k] * T[k] * T[k]
    for d in range(6):
        middle, along = 0.0, 0.0
        for k in range(len(T)):
            middle += weight[k] * J[k, d]
            along += weight[k] * J[k, d] * T[k]
        for k in range(len(T)):
            J[k, d] -= middle + along / max(squares, 1e-9) * T[k]
    return squares


@njit(cache=True, nogil=True)
def _aligned(image: U8, templates: U8, offsets: F64, shapes: F64, uv: F64) -> tuple[F64, F64, F64]:
    """Aligned pixels (N, 2), shapes (N, 2, 2) and correlations (N,) of templates, from initial `uv` and `shapes`."""
    positions, found, correlation = uv.copy(), shapes.copy(), np.zeros(len(uv))
    pixels = (PATCH_SIDE - 2) ** 2
    J, T, weight, value = np.empty((pixels, 6)), np.empty(pixels), np.empty(pixels), np.empty(pixels)
    H, g = np.empty((6, 6)), np.empty(6)
    for n in range(len(uv)):
        squares = _gradients(templates[n], offsets[n], weight, T, J)
        if squares < 1.0:
            continue
        for a in range(6):
            for b in range(a + 1):
                H[a, b] = 0.0
                for k in range(pixels):
                    H[a, b] += weight[k] * J[k, a] * J[k, b]
                H[b, a] = H[a, b]
        for a in range(6):  # parameters that the template doesn't determine keep their value
            H[a, a] += 1.0 if a > 1 else 1e-6
        inverse = np.linalg.inv(H)
        A, p = found[n], positions[n]
        for _ in range(ITERATIONS_MAX):
            # the image's mean-free values under the warped patch
            k, mean = 0, 0.0
            for i in range(1, PATCH_SIDE - 1):
                for j in range(1, PATCH_SIDE - 1):
                    x, y = j - PATCH_SIDE // 2 - offsets[n, 0], i - PATCH_SIDE // 2 - offsets[n, 1]
                    value[k] = _bilinear(image, p[0] + A[0, 0] * x + A[0, 1] * y, p[1] + A[1, 0] * x + A[1, 1] * y)
                    mean += weight[k] * value[k]
                    k += 1
            cross, own = 0.0, 0.0
            for k in range(pixels):
                value[k] -= mean
                cross += weight[k] * value[k] * T[k]
                own += weight[k] * value[k] * value[k]
            correlation[n] = cross / math.sqrt(max(own * squares, 1e-9))
            if cross <= 0:
                break
            g[:] = 0.0
            for k in range(pixels):
                e = weight[k] * (squares / cross * value[k] - T[k])
                for a in range(6):
                    g[a] += e * J[k, a]
            d = inverse @ g
            # inverse compositional: the patch moves by the inverse of the template's update
            B = np.array([[1 + d[2], d[3]], [d[4], 1 + d[5]]])
            det = B[0, 0] * B[1, 1] - B[0, 1] * B[1, 0]
            if det < 0.2:
                correlation[n] = 0.0
                break
            A[:] = A @ np.array([[B[1, 1] / det, -B[0, 1] / det], [-B[1, 0] / det, B[0, 0] / det]])
            p -= A @ d[:2]
            if math.hypot(p[0] - uv[n, 0], p[1] - uv[n, 1]) > 2 * SHIFT_MAX_PX:
                correlation[n] = 0.0
                break
            if math.hypot(d[0], d[1]) < STEP_MIN_PX:
                break
    return positions, found, correlation
