"""How near a rendering comes to a photo: likeness, outlines, signs. What counts is told by masks drawn by hand."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F64, I64, U8, Bools

TRUTH = Path(__file__).with_name("truth.json")

WINDOW = 1.5
"""Pixels: sigma of SSIM's Gaussian window (Wang et al. 2004)."""
FARTHEST = 12.0
"""Pixels within which a rendered outline is looked for, and what one that isn't found counts as."""
PROFILE, ALONG, STEP = 5.0, 3, 0.25
"""Pixels of a profile to each side of an outline, pixels along the outline that one is meaned over to each side,
and between two places of it."""
ALIKE = 0.6
"""Correlation of two profiles across an outline from which both show it."""


@cache
def truth() -> Mapping[str, Any]:
    """What was drawn by hand: street, frame, kind."""
    return dict(json.loads(TRUTH.read_text(encoding="utf-8")))


def filled(polygons: Sequence[Sequence[Sequence[float]]], shape: tuple[int, ...]) -> Bools:
    """(H, W) whether a pixel's middle lies in a polygon."""
    import cv2

    out = np.zeros(shape[:2], np.uint8)
    for polygon in polygons:
        cv2.fillPoly(out, [np.round((np.array(polygon) - 0.5) * 16).astype(np.int32)], 1, shift=4)
    return out > 0


def likeness(photo: U8, rgb: U8, counts: Bools) -> dict[str, float]:
    """Likeness where `counts` (H, W), after one least-squares gain a channel.

    Returns:
        psnr_db, mse, pixels; ssim (grey) of the windows of 11 x 11 that hold nothing but pixels that count; sharpness,
        the mean absolute Laplacian by the photo's.
    """
    from scipy.ndimage import binary_erosion, laplace

    like = gained(photo, rgb, counts)
    mse = squared_error(photo, like, counts)
    inner = binary_erosion(counts, np.ones((3, 3)))
    grey = [_grey(image) for image in (photo, like)]
    fine = [float(np.abs(laplace(image)[inner]).mean()) for image in grey]
    return {
        "psnr_db": psnr(mse),
        "ssim": _ssim(grey[0], grey[1], counts),
        "sharpness": fine[1] / fine[0],
        "mse": mse,
        "pixels": int(counts.sum()),
    }


def gained(photo: U8, rgb: U8, counts: Bools) -> F64:
    """The rendering with the gain a channel that makes it most like the photo where `counts`."""
    a, b = photo[counts].astype(np.float64), rgb[counts].astype(np.float64)
    return np.asarray(np.clip(rgb * ((a * b).sum(axis=0) / np.maximum((b * b).sum(axis=0), 1)), 0, 255))


def squared_error(photo: U8, like: npt.NDArray[Any], counts: Bools) -> float:
    """Mean squared error of all channels where `counts`."""
    return float(((like[counts].astype(np.float64) - photo[counts]) ** 2).mean())


def psnr(mse: float) -> float:
    """In dB, of a mean squared error of 8-bit values."""
    return 10 * math.log10(255**2 / max(mse, 1e-3))


def _grey(image: npt.NDArray[Any]) -> F64:
    return np.asarray(image @ np.array([0.299, 0.587, 0.114]), np.float64)


def _ssim(a: F64, b: F64, counts: Bools) -> float:
    from scipy.ndimage import binary_erosion, gaussian_filter

    def mean(values: F64) -> F64:
        return np.asarray(gaussian_filter(values, WINDOW, truncate=3.5))

    ma, mb = mean(a), mean(b)
    va, vb, cov = mean(a * a) - ma * ma, mean(b * b) - mb * mb, mean(a * b) - ma * mb
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    index = (2 * ma * mb + c1) * (2 * cov + c2) / ((ma * ma + mb * mb + c1) * (va + vb + c2))
    return float(index[binary_erosion(counts, np.ones((11, 11)))].mean())


def displacements(photo: U8, rgb: U8, line: Sequence[Sequence[float]]) -> tuple[F64, I64]:
    """Pixels by which a rendering shows an outline beside where the photo does, every second pixel along it.

    Returns:
        (N,) pixels, and the places' (N, 2) columns and rows.

    The photo's brightness across the outline, five pixels to each side, is looked for in the rendering's, shifted by
    up to `FARTHEST`; where nothing there is alike (correlation below `ALIKE`), it counts as so far off.

    Args:
        photo, rgb: (H, W, 3).
        line: drawn places (x, y), pixels.
    """
    from scipy.ndimage import map_coordinates

    places, ways = _along(np.array(line, np.float64) - 0.5)
    shown = [_grey(photo), _grey(rgb)]
    reach = np.arange(-PROFILE - FARTHEST, PROFILE + FARTHEST + STEP / 2, STEP)
    inner = slice(round(FARTHEST / STEP), len(reach) - round(FARTHEST / STEP))
    out, at = [], []
    for place, way in zip(places, ways, strict=True):
        normal = np.array([-way[1], way[0]])
        strip = place + way * np.arange(-ALONG, ALONG + 1)[:, None, None] + normal * reach[:, None]
        if not _within(strip[:, inner], photo.shape):
            continue
        across = [map_coordinates(g, strip[..., ::-1].reshape(-1, 2).T, order=1, mode="nearest") for g in shown]
        mine, other = (a.reshape(strip.shape[:2]).mean(axis=0) for a in across)
        out.append(_shift(mine[inner], other))
        at.append(np.round(place).astype(np.int64))
    return np.array(out), np.array(at, np.int64).reshape(-1, 2)


def _along(line: F64) -> tuple[F64, F64]:
    """Places every second pixel of a polyline, and the directions of it there."""
    places, ways = [], []
    for a, b in pairwise(line):
        length = float(np.linalg.norm(b - a))
        at = np.arange(1.0, max(length, 1.5), 2.0)
        places.append(a + (b - a) / length * at[:, None])
        ways.append(np.tile((b - a) / length, (len(at), 1)))
    return np.concatenate(places), np.concatenate(ways)


def _within(strip: F64, shape: tuple[int, ...]) -> bool:
    return bool((strip >= 0).all() and (strip <= np.array([shape[1] - 1, shape[0] - 1])).all())


def _shift(mine: F64, other: F64) -> float:
    """Pixels by which profile `mine` (n,) lies beside its place in `other` (m > n, its middle in the same place)."""
    windows = np.lib.stride_tricks.sliding_window_view(other, len(mine))
    windows = windows - windows.mean(axis=1, keepdims=True)
    size = np.linalg.norm(windows, axis=1) * np.linalg.norm(mine - mine.mean())
    alike = windows @ (mine - mine.mean()) / np.maximum(size, len(mine))
    offset = np.abs(np.arange(len(windows)) - len(windows) // 2) * STEP
    if alike.max() < ALIKE:
        return FARTHEST
    # of places that are about as like, the nearest: bars and stripes repeat
    return float(offset[alike > alike.max() - 0.02].min())
