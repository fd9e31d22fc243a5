"""Plane sweep stereo: inverse depth of a photo's pixels by comparison with other photos, regularized along scanlines.

Costs of the hypotheses (Collins 1996; best half of the photos against occlusion, Kang et al. 2001) are aggregated over
5 x 5 pixels and regularized by semi-global matching (Hirschmüller 2008). Pixels whose depth is known from the scan, and
sky, are constraints from which depth propagates: a crown joins its trunk. Import late: it loads numba.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit, prange

from scan2sim.pipeline.camera.models import MODEL_ID, parameters, project_point
from scan2sim.pipeline.camera.projection import rotate_to_camera, to_camera
from scan2sim.pipeline.core.types import F32, F64, I64, Bools
from scan2sim.texturing.backdrop.photos import Photo

CHANNELS = 4
"""Number of channels of `Photo.features`."""
HYPOTHESES = 64
"""Default number of hypotheses, equally spaced in inverse depth from infinity to `NEAREST_M`."""
NEAREST_M = 4.5
WINDOW_PX = 5
"""Window over which costs are averaged."""
MAX_COST = 60.0
"""Cost at which a pixel counts as different: sum over the channels of `Photo.features`."""
KNOWN_COST_PER_HYPOTHESIS, KNOWN_MAX_COST = 8.0, 40.0
"""Cost of a hypothesis at pixels whose depth the scan knows, by its distance from it; also that of sky at a depth."""
SMALL_STEP_COST, LARGE_STEP_COST = 2.0, 30.0
"""Costs of a change of depth between neighbouring pixels by one hypothesis, and by more."""
EDGE_LEVELS = 12.0
"""Brightness step between neighbours at which a change of depth costs half."""
DIRECTIONS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1))


def inverse_depth(photo: Photo, others: Sequence[Photo], hypotheses: int = HYPOTHESES) -> F32:
    """(H, W) inverse distance along the rays of a photo's pixels, 1/metres; 0 is infinity.

    Args:
        photo: reference photo.
        others: photos to compare it with; without any, depth comes from the scan's pixels alone.
        hypotheses: number of inverse depths that are compared.
    """
    import cv2

    height, width = photo.wanted.shape
    step = 1 / NEAREST_M / (hypotheses - 1)
    per_hypothesis = KNOWN_COST_PER_HYPOTHESIS * (HYPOTHESES - 1) / (hypotheses - 1)
    cost = np.zeros((height, width, hypotheses), np.float32)
    if others:
        kernel = np.ones((WINDOW_PX + 2, WINDOW_PX + 2))
        compared: Bools = np.asarray(cv2.dilate(photo.wanted.astype(np.uint8), kernel) > 0)
        features, sizes = _padded([other.features for other in others])
        models = np.array([MODEL_ID[other.camera.model] for other in others])
        cameras = np.stack([parameters(other.camera) for other in others])
        poses = np.stack([np.linalg.inv(other.view.T_world_cam) for other in others])
        half, each = (len(others) + 1) // 2, np.full((len(others), height, width), MAX_COST, np.float32)
        window = np.empty_like(each)
        rays, centre = photo.rays, np.asarray(photo.view.centre, np.float64)
        for d in range(hypotheses):
            inverse = d * step
            _compare(photo.features, rays, centre, compared, inverse, features, sizes, models, cameras, poses, each)
            for one, smooth in zip(each, window, strict=True):
                cv2.blur(one, (WINDOW_PX, WINDOW_PX), smooth)
            _mean_of_best(window, half, photo.wanted, cost[..., d])
    index = np.arange(hypotheses)
    known = np.isfinite(photo.known)
    hypothesis = np.minimum(1 / np.maximum(photo.known[known], 1e-3) / step, hypotheses - 1)
    cost[known] = np.minimum(np.abs(index - hypothesis[:, None]) * per_hypothesis, KNOWN_MAX_COST)
    cost[photo.sky] = np.where(index == 0, 0, KNOWN_MAX_COST)
    grey = photo.grey
    contrast = np.abs(np.gradient(grey, axis=0)) + np.abs(np.gradient(grey, axis=1))
    total = _semi_global(cost, (LARGE_STEP_COST / (1 + contrast / EDGE_LEVELS)).astype(np.float32))
    return _minimum(total, step)


def _padded(images: Sequence[F32]) -> tuple[F32, I64]:
    """Images (h, w, C) of several sizes as one array (K, H, W, C), and their heights and widths (K, 2)."""
    sizes = np.array([image.shape[:2] for image in images], np.int64)
    padded = np.zeros((len(images), *sizes.max(axis=0), images[0].shape[2]), np.float32)
    for one, image in zip(padded, images, strict=True):
        one[: image.shape[0], : image.shape[1]] = image
    return padded, sizes


def _minimum(total: F32, step: float) -> F32:
    """Position of the minimum along the last axis, refined by a parabola, as inverse depth in steps of `step`."""
    best = total.argmin(axis=2)
    inner = np.clip(best, 1, total.shape[2] - 2)
    left, middle, right = (np.take_along_axis(total, (inner + k)[..., None], 2)[..., 0] for k in (-1, 0, 1))
    curvature = left - 2 * middle + right
    offset = np.clip(0.5 * (left - right) / np.maximum(curvature, 1e-6), -0.5, 0.5)
    return ((best + np.where((best == inner) & (curvature > 1e-6), offset, 0)) * step).astype(np.float32)


def _semi_global(cost: F32, large_step: F32) -> F32:
    """Sum (H, W, D) of the minimal path costs from eight directions."""
    height, width, _ = cost.shape
    total = np.zeros_like(cost)
    for down, right in DIRECTIONS:
        rows, columns = np.indices((height, width)).reshape(2, -1)
        first = np.zeros(len(rows), bool)
        if down:
            first |= rows == (0 if down > 0 else height - 1)
        if right:
            first |= columns == (0 if right > 0 else width - 1)
        _along_lines(cost, large_step, rows[first], columns[first], down, right, total)
    return total


@njit(cache=True, parallel=True)
def _along_lines(cost: F32, large_step: F32, rows: I64, columns: I64, down: int, right: int, total: F32) -> None:
    for i in prange(len(rows)):
        _along_line(cost, large_step, rows[i], columns[i], down, right, total)


@njit(cache=True)
def _along_line(cost: F32, large_step: F32, row: int, column: int, down: int, right: int, total: F32) -> None:
    """Add the path costs of one line of pixels to `total`."""
    height, width, count = cost.shape
    before, here, lowest = np.zeros(count, np.float32), np.zeros(count, np.float32), np.float32(0)
    small, is_first = np.float32(SMALL_STEP_COST), True
    while 0 <= row < height and 0 <= column < width:
        jump, minimum = lowest + large_step[row, column], np.float32(np.inf)
        for d in range(count):
            value = cost[row, column, d]
            if not is_first:
                path = min(before[d], jump)
                if d > 0:
                    path = min(path, before[d - 1] + small)
                if d < count - 1:
                    path = min(path, before[d + 1] + small)
                value += path - lowest
            here[d] = value
            total[row, column, d] += value
            minimum = min(minimum, value)
        before[:] = here
        lowest, is_first = minimum, False
        row, column = row + down, column + right


@njit(cache=True, parallel=True)
def _compare(
    own: F32,
    rays: F64,
    centre: F64,
    compared: Bools,
    inverse: float,
    features: F32,
    sizes: I64,
    models: I64,
    cameras: F64,
    poses: F64,
    out: F32,
) -> None:
    """Difference (K, H, W) of a photo's pixels at an inverse depth to those of K other photos, `MAX_COST` outside.

    Args:
        own, rays, centre: features (H, W, C), unit rays (H, W, 3) and centre of the photo.
        compared: (H, W) pixels to compute.
        inverse: inverse distance along the rays, 1/metres.
        features, sizes, models, cameras, poses: of the others; (K, h, w, C), heights and widths (K, 2), (K,), (K, 15)
            and (K, 4, 4) world to camera.
        out: receives the differences.
    """
    height, width = compared.shape
    for row in prange(height):
        for k in range(len(features)):
            image, model, camera, T = features[k], models[k], cameras[k], poses[k]
            # homogeneous point, so that infinity is a point as well
            x0, y0, z0 = to_camera(T, centre[0], centre[1], centre[2])
            x0, y0, z0 = x0 * inverse, y0 * inverse, z0 * inverse
            for column in range(width):
                if not compared[row, column]:
                    continue
                ray = rays[row, column]
                x, y, z = rotate_to_camera(T, ray[0], ray[1], ray[2])
                u, v, ok = project_point(model, camera, x0 + x, y0 + y, z0 + z)
                out[k, row, column] = MAX_COST
                if ok and 0 <= u < sizes[k, 1] - 1 and 0 <= v < sizes[k, 0] - 1:
                    out[k, row, column] = min(_difference(own[row, column], image, u, v), MAX_COST)


@njit(cache=True, inline="always")
def _difference(own: F32, image: F32, u: float, v: float) -> float:
    """Sum of absolute differences over the channels, bilinear."""
    column, row = int(u), int(v)
    x, y, total = np.float32(u - column), np.float32(v - row), np.float32(0)
    a, b = (1 - x) * (1 - y), x * (1 - y)
    c, d = (1 - x) * y, x * y
    upper, lower = image[row], image[row + 1]
    for k in range(CHANNELS):
        total += abs(
            upper[column, k] * a + upper[column + 1, k] * b + lower[column, k] * c + lower[column + 1, k] * d - own[k]
        )
    return float(total)


@njit(cache=True, parallel=True)
def _mean_of_best(costs: F32, count: int, wanted: Bools, out: F32) -> None:
    """Mean (H, W) of the `count` smallest of K costs (K, H, W), at the wanted pixels (H, W)."""
    height, width = out.shape
    for row in prange(height):
        best = np.empty(count, np.float32)
        for column in range(width):
            if not wanted[row, column]:
                continue
            best[:] = np.inf
            for k in range(len(costs)):
                cost, at = costs[k, row, column], count - 1
                if cost >= best[at]:
                    continue
                while at > 0 and best[at - 1] > cost:
                    best[at] = best[at - 1]
                    at -= 1
                best[at] = cost
            out[row, column] = best.sum() / np.float32(count)


def neighbours(photos: Sequence[Photo], index: int, min_baseline: float) -> list[int]:
    """Photos to compare one with: near and farther ones (the 1st, 2nd, 4th and 8th nearest to each side of a drive).

    Photos nearer than `min_baseline` metres, or that look elsewhere (more than 60 degrees), are left out.
    """
    own = photos[index].view
    distance = np.array([np.linalg.norm(photo.view.centre - own.centre) for photo in photos])
    ahead = np.array([photo.view.T_world_cam[:3, 2] @ own.T_world_cam[:3, 2] for photo in photos])
    panorama = own.camera.model == "equirectangular"
    order = [int(i) for i in np.argsort(distance, kind="stable") if distance[i] >= min_baseline]
    order = [i for i in order if panorama or ahead[i] > 0.5]
    return [order[k] for k in (0, 1, 2, 3, 6, 7, 14, 15) if k < len(order)]
