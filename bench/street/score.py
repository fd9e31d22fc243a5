"""Image metrics between a rendering and a photo: similarity, outlines, signs, within masks drawn by hand."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F64, I64, U8, Bools
from scan2sim.texturing.evaluate import psnr as psnr

TRUTH = Path(__file__).with_name("truth.json")

SSIM_SIGMA_PX = 1.5
"""Sigma of SSIM's Gaussian window (Wang et al. 2004)."""
MAX_SHIFT_PX = 12.0
"""Search range for a rendered outline, and the displacement of one that isn't found."""
PROFILE_PX, AVERAGE_PX, STEP_PX = 5.0, 3, 0.25
"""Half length of a profile across an outline, half length of averaging along it, sampling distance of profiles."""
MIN_CORRELATION = 0.6
"""Minimum correlation of two profiles that show the same outline."""


@cache
def truth() -> Mapping[str, Any]:
    """Hand-drawn ground truth: street, frame, kind."""
    return dict(json.loads(TRUTH.read_text(encoding="utf-8")))


def filled(polygons: Sequence[Sequence[Sequence[float]]], shape: tuple[int, ...]) -> Bools:
    """(H, W) whether a pixel's centre lies in a polygon."""
    import cv2

    out = np.zeros(shape[:2], np.uint8)
    for polygon in polygons:
        cv2.fillPoly(out, [np.round((np.array(polygon) - 0.5) * 16).astype(np.int32)], 1, shift=4)
    return out > 0


def similarity(photo: U8, rgb: U8, counts: Bools) -> dict[str, float]:
    """Similarity where `counts` (H, W), after a least-squares gain per channel.

    Returns:
        psnr_db, nogain_psnr_db (as rendered), mse, pixels; ssim (grey) over windows of 11 x 11 in which all pixels
        count; sharpness, the mean absolute Laplacian relative to the photo's.
    """
    from scipy.ndimage import binary_erosion, laplace

    like = apply_gain(rgb, solve_gain(photo, rgb, counts))
    mse = squared_error(photo, like, counts)
    inner = binary_erosion(counts, np.ones((3, 3)))
    grey = [_grey(image) for image in (photo, like)]
    fine = [float(np.abs(laplace(image)[inner]).mean()) for image in grey]
    return {
        "psnr_db": psnr(mse),
        "nogain_psnr_db": psnr(squared_error(photo, rgb, counts)),
        "ssim": ssim(photo, like, counts),
        "sharpness": fine[1] / fine[0],
        "mse": mse,
        "pixels": int(counts.sum()),
    }


def solve_gain(photo: U8, rgb: U8, counts: Bools) -> F64:
    """(3,) gain per channel of the rendering that minimizes the error to the photo where `counts`; 1 if nowhere."""
    a, b = photo[counts].astype(np.float64), rgb[counts].astype(np.float64)
    return np.asarray((a * b).sum(axis=0) / np.maximum((b * b).sum(axis=0), 1)) if counts.any() else np.ones(3)


def apply_gain(rgb: U8, gain: F64) -> F64:
    """The rendering (H, W, 3) times a gain (3,) per channel, clipped to 0-255."""
    return np.asarray(np.clip(rgb * gain, 0, 255))


def squared_error(photo: U8, like: npt.NDArray[Any], counts: Bools) -> float:
    """Mean squared error over all channels where `counts`."""
    return float(((like[counts].astype(np.float64) - photo[counts]) ** 2).mean())


def _grey(image: npt.NDArray[Any]) -> F64:
    return np.asarray(image @ np.array([0.299, 0.587, 0.114]), np.float64)


def ssim(photo: U8, like: npt.NDArray[Any], counts: Bools) -> float:
    """Mean SSIM of the grey images over windows of 11 x 11 pixels in which all pixels count."""
    from scipy.ndimage import binary_erosion, gaussian_filter

    a, b = _grey(photo), _grey(like)

    def mean(values: F64) -> F64:
        return np.asarray(gaussian_filter(values, SSIM_SIGMA_PX, truncate=3.5))

    ma, mb = mean(a), mean(b)
    va, vb, cov = mean(a * a) - ma * ma, mean(b * b) - mb * mb, mean(a * b) - ma * mb
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    index = (2 * ma * mb + c1) * (2 * cov + c2) / ((ma * ma + mb * mb + c1) * (va + vb + c2))
    return float(index[binary_erosion(counts, np.ones((11, 11)))].mean())


def displacements(photo: U8, rgb: U8, line: Sequence[Sequence[float]]) -> tuple[F64, I64]:
    """Displacement in pixels of an outline in a rendering relative to the photo, every second pixel along it.

    Returns:
        (N,) displacements, and the columns and rows of the samples (N, 2).

    The photo's brightness profile across the outline, five pixels to each side, is searched in the rendering's profile
    within `MAX_SHIFT_PX`; without a match (correlation below `MIN_CORRELATION`), the displacement is the maximum.

    Args:
        photo, rgb: (H, W, 3).
        line: drawn polyline (x, y), pixels.
    """
    from scipy.ndimage import map_coordinates

    points, directions = _along(np.array(line, np.float64) - 0.5)
    grey = [_grey(photo), _grey(rgb)]
    reach = np.arange(-PROFILE_PX - MAX_SHIFT_PX, PROFILE_PX + MAX_SHIFT_PX + STEP_PX / 2, STEP_PX)
    inner = slice(round(MAX_SHIFT_PX / STEP_PX), len(reach) - round(MAX_SHIFT_PX / STEP_PX))
    out, at = [], []
    for point, direction in zip(points, directions, strict=True):
        normal = np.array([-direction[1], direction[0]])
        strip = point + direction * np.arange(-AVERAGE_PX, AVERAGE_PX + 1)[:, None, None] + normal * reach[:, None]
        if not _within(strip[:, inner], photo.shape):
            continue
        across = [map_coordinates(g, strip[..., ::-1].reshape(-1, 2).T, order=1, mode="nearest") for g in grey]
        mine, other = (a.reshape(strip.shape[:2]).mean(axis=0) for a in across)
        out.append(_shift(mine[inner], other))
        at.append(np.round(point).astype(np.int64))
    return np.array(out), np.array(at, np.int64).reshape(-1, 2)


def _along(line: F64) -> tuple[F64, F64]:
    """Samples every second pixel of a polyline, and its directions there."""
    points, directions = [], []
    for a, b in pairwise(line):
        length = float(np.linalg.norm(b - a))
        at = np.arange(1.0, max(length, 1.5), 2.0)
        points.append(a + (b - a) / length * at[:, None])
        directions.append(np.tile((b - a) / length, (len(at), 1)))
    return np.concatenate(points), np.concatenate(directions)


def _within(strip: F64, shape: tuple[int, ...]) -> bool:
    return bool((strip >= 0).all() and (strip <= np.array([shape[1] - 1, shape[0] - 1])).all())


def _shift(mine: F64, other: F64) -> float:
    """Displacement in pixels of profile `mine` (n,) in `other` (m > n, with the same centre)."""
    windows = np.lib.stride_tricks.sliding_window_view(other, len(mine))
    windows = windows - windows.mean(axis=1, keepdims=True)
    size = np.linalg.norm(windows, axis=1) * np.linalg.norm(mine - mine.mean())
    alike = windows @ (mine - mine.mean()) / np.maximum(size, len(mine))
    offset = np.abs(np.arange(len(windows)) - len(windows) // 2) * STEP_PX
    if alike.max() < MIN_CORRELATION:
        return MAX_SHIFT_PX
    # of about equally similar matches, the nearest: bars and stripes repeat
    return float(offset[alike > alike.max() - 0.02].min())
