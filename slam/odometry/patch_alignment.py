"""Patches: what features looked like where they were found; each is laid onto every new picture, so that none drifts.

Followed from each frame to the next alone, a feature adds up what every step is off by. Here it is aligned with its
first look: in place, affine shape, gain and offset, by Gauss-Newton with the patch's own gradients (Baker and
Matthews, "Lucas-Kanade 20 years on", IJCV 2004: inverse compositional), from where it was followed to, in the shape
that it had in the frame before (Shi and Tomasi, "Good features to track", CVPR 1994). Import late: numba.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numba import njit

from scan2sim.pipeline.core.types import F32, F64, I32, I64, U8, Bools

HALF = 5
"""Pixels from a patch's middle to its edge; one more is kept about it, for gradients."""
SPREAD = 3.0
"""Pixels, standard deviation of the weight that falls off from the feature: what is beside it moves otherwise."""
ITERATIONS, STILL = 10, 0.01
"""How often a patch is moved at most; a step smaller than so many pixels is the last."""
ALIKE = 0.9
"""Correlation with its look below which a feature is lost."""
STRAY = 1.5
"""Pixels between where a feature was followed to and where it is aligned, beyond which it is lost."""
ZOOM = 1.6
"""A look that is enlarged, shrunk or sheared by more is taken anew: finer or coarser, it shows something else."""

SIDE = 2 * HALF + 3


@dataclass
class Patches:
    """Looks of features.

    Attributes:
        ids: (N,) of tracks, ascending.
        facet: (N,) in which each is aligned.
        look: (N, SIDE, SIDE) grey values.
        offset: (N, 2) pixels from the look's middle to the feature, half a one at most.
        shape: (N, 2, 2) what offsets in the look have become in the last picture.
    """

    ids: I64 = field(default_factory=lambda: np.zeros(0, np.int64))
    facet: I32 = field(default_factory=lambda: np.zeros(0, np.int32))
    look: U8 = field(default_factory=lambda: np.zeros((0, SIDE, SIDE), np.uint8))
    offset: F64 = field(default_factory=lambda: np.zeros((0, 2)))
    shape: F64 = field(default_factory=lambda: np.zeros((0, 2, 2)))

    def find(self, ids: I64) -> tuple[I64, Bools]:
        """(N,) rows of ids, and whether each is known."""
        if not len(self.ids):
            return np.zeros(len(ids), np.int64), np.zeros(len(ids), bool)
        rows = np.minimum(np.searchsorted(self.ids, ids), len(self.ids) - 1)
        return rows, self.ids[rows] == ids

    def keep(self, ids: I64) -> None:
        """Forget all others."""
        mask = np.isin(self.ids, ids)
        self.ids, self.facet, self.look = self.ids[mask], self.facet[mask], self.look[mask]
        self.offset, self.shape = self.offset[mask], self.shape[mask]

    def take(self, ids: I64, facet: int, picture: U8, uv: F32 | F64) -> None:
        """How features at places (N, 2) look in a facet's picture; again, or for the first time."""
        self.keep(self.ids[~np.isin(self.ids, ids)])
        uv = np.asarray(uv, np.float64)
        middle: F64 = np.round(uv)
        look = _taken(picture, middle.astype(np.int64))
        order = np.argsort(np.concatenate([self.ids, ids]), kind="stable")
        self.ids = np.concatenate([self.ids, ids])[order]
        self.facet = np.concatenate([self.facet, np.full(len(ids), facet, np.int32)])[order]
        self.look = np.concatenate([self.look, look])[order]
        self.offset = np.concatenate([self.offset, uv - middle])[order]
        self.shape = np.concatenate([self.shape, np.tile(np.eye(2), (len(ids), 1, 1))])[order]

    def lay(self, ids: I64, facet: int, picture: U8, uv: F32) -> F64:
        """Places (N, 2) of known features in a picture, near places (N, 2); NaN where one doesn't look as it did."""
        height, width = picture.shape
        rows, _ = self.find(ids)
        inside = np.asarray(((uv > 0) & (uv < (width - 1, height - 1))).all(axis=1))  # NaN isn't
        start = np.where(inside[:, None], uv, 0.0)
        place, shape, alike = _aligned(picture, self.look[rows], self.offset[rows], self.shape[rows], start)
        good = inside & (alike > ALIKE) & (np.linalg.norm(place - start, axis=1) < STRAY)
        self.shape[rows[good]] = shape[good]
        stretch = np.linalg.svd(shape, compute_uv=False)
        other = good & ((stretch[:, 0] > ZOOM) | (stretch[:, 1] < 1 / ZOOM))
        if other.any():
            self.take(ids[other], facet, picture, place[other])
        place[~good] = np.nan
        return place


@njit(cache=True, nogil=True)
def _taken(picture: U8, middle: I64) -> U8:
    """(N, SIDE, SIDE) about pixels (N, 2); beyond a picture's edge, its edge."""
    height, width = picture.shape
    out = np.empty((len(middle), SIDE, SIDE), np.uint8)
    for n in range(len(middle)):
        for i in range(SIDE):
            row = min(max(middle[n, 1] + i - SIDE // 2, 0), height - 1)
            for j in range(SIDE):
                out[n, i, j] = picture[row, min(max(middle[n, 0] + j - SIDE // 2, 0), width - 1)]
    return out


@njit(cache=True, inline="always")
def _at(picture: U8, x: float, y: float) -> float:
    """A grey value between pixels."""
    height, width = picture.shape
    x, y = min(max(x, 0.0), width - 1.001), min(max(y, 0.0), height - 1.001)
    c, r = int(x), int(y)
    a, b = x - c, y - r
    above = (1 - a) * picture[r, c] + a * picture[r, c + 1]
    return float((1 - b) * above + b * ((1 - a) * picture[r + 1, c] + a * picture[r + 1, c + 1]))


@njit(cache=True, nogil=True)
def _gradients(look: U8, offset: F64, weight: F64, T: F64, J: F64) -> float:
    """Fill in a look's values T (K,) about their mean, their derivatives J (K, 6) by what moves them, and weights (K,).

    J is made orthogonal to what gain and offset explain. Returns the weighted sum of squares of T.
    """
    k, total, mean = 0, 0.0, 0.0
    for i in range(1, SIDE - 1):
        for j in range(1, SIDE - 1):
            x, y = j - SIDE // 2 - offset[0], i - SIDE // 2 - offset[1]
            w = math.exp(-(x * x + y * y) / (2 * SPREAD * SPREAD))
            gx = (float(look[i, j + 1]) - float(look[i, j - 1])) / 2
            gy = (float(look[i + 1, j]) - float(look[i - 1, j])) / 2
            J[k, 0], J[k, 1], J[k, 2], J[k, 3], J[k, 4], J[k, 5] = gx, gy, gx * x, gx * y, gy * x, gy * y
            weight[k], T[k] = w, look[i, j]
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
def _aligned(picture: U8, looks: U8, offsets: F64, shapes: F64, uv: F64) -> tuple[F64, F64, F64]:
    """Places (N, 2), shapes (N, 2, 2) and correlations (N,) of looks in a picture, begun at places and in shapes."""
    places, found, alike = uv.copy(), shapes.copy(), np.zeros(len(uv))
    pixels = (SIDE - 2) ** 2
    J, T, weight, value = np.empty((pixels, 6)), np.empty(pixels), np.empty(pixels), np.empty(pixels)
    H, g = np.empty((6, 6)), np.empty(6)
    for n in range(len(uv)):
        squares = _gradients(looks[n], offsets[n], weight, T, J)
        if squares < 1.0:
            continue
        for a in range(6):
            for b in range(a + 1):
                H[a, b] = 0.0
                for k in range(pixels):
                    H[a, b] += weight[k] * J[k, a] * J[k, b]
                H[b, a] = H[a, b]
        for a in range(6):  # what the look can't tell stays as it was
            H[a, a] += 1.0 if a > 1 else 1e-6
        inverse = np.linalg.inv(H)
        A, p = found[n], places[n]
        for _ in range(ITERATIONS):
            # the picture's values where the patch now lies, about their mean
            k, mean = 0, 0.0
            for i in range(1, SIDE - 1):
                for j in range(1, SIDE - 1):
                    x, y = j - SIDE // 2 - offsets[n, 0], i - SIDE // 2 - offsets[n, 1]
                    value[k] = _at(picture, p[0] + A[0, 0] * x + A[0, 1] * y, p[1] + A[1, 0] * x + A[1, 1] * y)
                    mean += weight[k] * value[k]
                    k += 1
            cross, own = 0.0, 0.0
            for k in range(pixels):
                value[k] -= mean
                cross += weight[k] * value[k] * T[k]
                own += weight[k] * value[k] * value[k]
            alike[n] = cross / math.sqrt(max(own * squares, 1e-9))
            if cross <= 0:
                break
            g[:] = 0.0
            for k in range(pixels):
                e = weight[k] * (squares / cross * value[k] - T[k])
                for a in range(6):
                    g[a] += e * J[k, a]
            d = inverse @ g
            # the patch is moved by the inverse of what would move the look
            B = np.array([[1 + d[2], d[3]], [d[4], 1 + d[5]]])
            det = B[0, 0] * B[1, 1] - B[0, 1] * B[1, 0]
            if det < 0.2:
                alike[n] = 0.0
                break
            A[:] = A @ np.array([[B[1, 1] / det, -B[0, 1] / det], [-B[1, 0] / det, B[0, 0] / det]])
            p -= A @ d[:2]
            if math.hypot(p[0] - uv[n, 0], p[1] - uv[n, 1]) > 2 * STRAY:
                alike[n] = 0.0
                break
            if math.hypot(d[0], d[1]) < STILL:
                break
    return places, found, alike
