"""Facade stereo: evidence from photos for the extent of a wall beyond its scanned part, by plane-sweep stereo.

Photos from several positions along the path are rectified to the plane of the wall (Gallup et al., "Real-time
plane-sweeping stereo with multiple sweeping directions", CVPR 2007). Texture on the wall is photo-consistent on this
plane; texture in front of or behind it is consistent on a parallel plane. Untextured areas must have the colour of the
scanned wall below. Import lazily: it loads numba.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.buildings.facade_completion import Wall
from scan2sim.pipeline.camera.depth_map import DepthMap, visible
from scan2sim.pipeline.camera.models import pixel_angle
from scan2sim.pipeline.camera.projection import pixels
from scan2sim.pipeline.core.types import F32, I32, U8, Bools, View

TEXELS_PER_CELL = 2
"""Samples of the photos along the side of a cell."""
WINDOW_M = 0.75
"""Size of the compared patches."""
REFERENCE_HEIGHT_M = 1.5
"""Height of the part below the scanned top whose colour is the reference for untextured areas."""


@dataclass(frozen=True)
class StereoLimits:
    """Parameters of the plane sweep."""

    plane_offsets_m: tuple[float, ...] = (-0.7, 0.7, 1.6, 3.5, 8.0)  # parallel planes behind (> 0) or in front
    min_correlation_gain: float = 0.05  # by which another plane must be better than the wall's
    max_photos: int = 8  # compared photos, spread along the path
    preview_texels_per_cell: float = 0.25  # resolution at which photos that see the wall are selected
    max_distance_m: float = 60.0  # of photos
    min_cos_incidence: float = 0.1
    max_gsd_m: float = 0.25  # largest ground sample distance on the wall
    occluder_distance_m: float = 0.3  # objects farther in front of the wall occlude it
    min_texture_std: float = 3.0  # grey levels; patches with less are untextured
    edge_step: float = 12.0  # grey level difference at a sharp edge
    max_plain_difference: float = 25.0  # grey levels between an untextured area and the scanned wall below
    overexposed_level: float = 245.0  # grey level from which the true brightness is unknown
    unseen_value: float = -0.1  # evidence of a cell that fewer than two photos see


LIMITS = StereoLimits()


@dataclass(frozen=True)
class Photo:
    """A photo to compare.

    Attributes:
        view: its camera and pose.
        levels: grey image pyramid, uint8: full size, half, quarter.
        usable: (H, W) uint8 mask, 0 where it must not be used; None: usable everywhere.
        sky: (h, w) uint8 probability of sky, 255 is certain; None: unknown.
        depth: range image of the cloud.
    """

    view: View
    levels: tuple[U8, ...]
    usable: U8 | None
    sky: U8 | None
    depth: DepthMap


@dataclass(frozen=True)
class Patch:
    """A photo rectified to the plane of a wall: grey levels (H, W), visibility, and probability of sky (0 to 1)."""

    grey: F32
    seen: Bools
    sky: F32


def rectify(wall: Wall, photo: Photo, offset: float = 0.0, texels: float = TEXELS_PER_CELL) -> Patch:
    """A photo rectified to a wall's plane, moved back by `offset` metres.

    Args:
        wall: the wall, whose rows and columns are sampled.
        photo: photo to sample.
        offset: distance of the plane behind the wall, metres.
        texels: number of samples along the side of a cell.
    """
    rows, columns = (max(1, round(n * texels)) for n in wall.known.shape)
    r, c = (np.arange(n) for n in (rows, columns))
    places = wall.places(((r + 0.5) / texels - 0.5)[:, None], ((c + 0.5) / texels - 0.5)[None, :])
    flat = places.reshape(-1, 3) - offset * wall.normal
    camera, ray = photo.view.camera, flat - photo.view.centre
    distance = np.linalg.norm(ray, axis=1)
    cos = -(ray @ wall.normal) / np.maximum(distance, 1e-9)
    pixel = distance * pixel_angle(camera)
    seen = (cos > LIMITS.min_cos_incidence) & (distance < LIMITS.max_distance_m) & (pixel < LIMITS.max_gsd_m * cos)
    uv = np.full((len(flat), 2), -1, np.float32)
    if seen.any():
        at = np.flatnonzero(seen)
        uv[at], valid = pixels(camera, photo.view.T_world_cam, flat[at])
        valid[valid] = visible(photo.depth, flat[at[valid]] + LIMITS.occluder_distance_m * wall.normal)
        seen[at] = valid
    finer = wall.cell / texels / float(np.median(pixel[seen])) if seen.any() else 1.0
    level = int(np.clip(np.log2(max(finer, 1.0)) + 0.3, 0, len(photo.levels) - 1))
    u, v = (uv[:, k].reshape(rows, columns) for k in (0, 1))

    def sampled(picture: npt.NDArray[np.generic]) -> F32:
        fx, fy = picture.shape[1] / camera.width, picture.shape[0] / camera.height
        x, y = (u + 0.5) * fx - 0.5, (v + 0.5) * fy - 0.5
        # OpenCV on a whole single-channel image takes a quarter of the time of `pipeline.camera.image_sampling`
        return np.asarray(cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32)

    seen = seen.reshape(rows, columns)
    if photo.usable is not None:
        seen &= sampled(photo.usable) > 0
    sky = np.zeros((rows, columns), np.float32) if photo.sky is None else sampled(photo.sky) / np.float32(255)
    return Patch(sampled(photo.levels[level]), seen, sky)


def evidence(wall: Wall, photos: Sequence[Photo]) -> tuple[F32, F32]:
    """Evidence of the photos for each cell.

    Returns:
        (R, C) evidence from about -1 (not the wall) to 1 (wall); and (R, C) strength (0 to 1) of the image edge at the
        upper side of each cell, as at the top of a wall.
    """
    chosen = [photo for photo in photos if rectify(wall, photo, 0.0, LIMITS.preview_texels_per_cell).seen.any()]
    chosen = [chosen[round(k)] for k in np.linspace(0, len(chosen) - 1, min(LIMITS.max_photos, len(chosen)))]
    if len(chosen) < 2:
        return np.full(wall.known.shape, LIMITS.unseen_value, np.float32), np.zeros(wall.known.shape, np.float32)
    window = 2 * round(WINDOW_M / 2 / wall.cell * TEXELS_PER_CELL) + 1
    own = [rectify(wall, photo) for photo in chosen]
    consistency, contrast, count = photo_consistency(_equalize_exposure(own, wall), window)
    elsewhere = np.full_like(consistency, -1.0)
    for offset in LIMITS.plane_offsets_m:
        other, _, seen_by = photo_consistency([rectify(wall, photo, offset) for photo in chosen], window)
        elsewhere = np.maximum(elsewhere, np.where(seen_by >= 2, other, -1.0))
    light = _mean([p.grey for p in _equalize_exposure(own, wall)], [p.seen for p in own])
    sky = _mean([p.sky for p in own], [p.seen for p in own])
    textured = np.clip(2 * consistency - 1, -0.5, 0.5) - np.clip(
        4 * (elsewhere - consistency - LIMITS.min_correlation_gain), 0, 1
    )
    plain = np.where(
        np.abs(light - _reference_level(light, wall)) < LIMITS.max_plain_difference,
        np.where(light < LIMITS.overexposed_level, 0.05, LIMITS.unseen_value),
        -0.4,
    )
    value = np.where(contrast > LIMITS.min_texture_std, textured, plain) - 1.5 * np.clip(sky - 0.3, 0, 1)
    value = _shift_up(np.where(count >= 2, value, LIMITS.unseen_value).astype(np.float32), count >= 2, window // 2)
    return _cells(value), _edges(_cells(light), _cells((count >= 2).astype(np.float32)) == 1)


def photo_consistency(patches: Sequence[Patch], window: int) -> tuple[F32, F32, I32]:
    """Photo consistency of the patches around each texel.

    Returns:
        (H, W) mean correlation with the mean of the other photos, over the photos that correlate; (H, W) mean standard
        deviation of the patches, grey levels; and (H, W) number of photos that see the texel.
    """
    masks = np.stack([p.seen for p in patches]).astype(np.float32)
    grey = np.stack([p.grey for p in patches]) * masks
    weight = np.stack([_box(m, window) for m in masks])
    mean = np.stack([_box(g, window) for g in grey]) / np.maximum(weight, 1e-3)
    square = np.stack([_box(g * g, window) for g in grey]) / np.maximum(weight, 1e-3)
    deviation = np.sqrt(np.maximum(square - mean * mean, 0))
    own = (grey - mean) / np.maximum(deviation, 1.0) * masks
    full = masks * (weight > 0.4)
    support = np.ones_like(full)
    for _ in range(2):
        total, number = (own * full * support).sum(axis=0), (full * support).sum(axis=0)
        rest = (total - own * full * support) / np.maximum(number - full * support, 1)
        length = np.sqrt(np.maximum(np.stack([_box(r * r, window) for r in rest]), 1e-6))
        size = np.sqrt(np.maximum(np.stack([_box(o * o, window) for o in own]), 1e-6))
        correlation = np.stack([_box(o * r, window) for o, r in zip(own, rest, strict=True)]) / (length * size)
        correlation = np.where((number - full * support) > 0, correlation, 0)
        support = (correlation > 0.3).astype(np.float32)
    count = full.sum(axis=0)
    supporting = (support * full).sum(axis=0)
    alike = (correlation * support * full).sum(axis=0) / np.maximum(supporting, 1)
    alike = alike * np.minimum(1, supporting / np.maximum(2, 0.5 * count))
    deep = (deviation * full).sum(axis=0) / np.maximum(count, 1)
    return alike.astype(np.float32), deep.astype(np.float32), count.astype(np.int32)


def _equalize_exposure(patches: Sequence[Patch], wall: Wall) -> list[Patch]:
    """Scale the patches to the same mean brightness on the scanned part of the wall."""
    known = np.kron(wall.known, np.ones((TEXELS_PER_CELL, TEXELS_PER_CELL), np.uint8)) > 0
    light = np.array([np.mean(p.grey[known & p.seen]) if (known & p.seen).any() else np.nan for p in patches])
    gain = (
        np.nan_to_num(np.nanmean(light) / np.maximum(light, 1), nan=1.0) if np.isfinite(light).any() else light * 0 + 1
    )
    return [Patch(p.grey * np.float32(g), p.seen, p.sky) for p, g in zip(patches, gain, strict=True)]


def _shift_up(value: F32, seen: Bools, half: int) -> F32:
    """Shift values by half a patch: patches that contain an edge are consistent up to half a patch above it."""
    up, there = np.roll(value, -half, axis=0), np.roll(seen, -half, axis=0)
    there[-half:] = False
    return np.where(there, up, value)


def _edges(light: F32, seen: Bools) -> F32:
    """Edge strength (R, C) from 0 to 1 above each cell of grey levels (R, C); non-maxima of three rows are 0."""
    smooth = cv2.blur(light, (5, 1), borderType=cv2.BORDER_REPLICATE)
    change = np.zeros_like(smooth)
    inner = seen[:-3] & seen[1:-2] & seen[2:-1] & seen[3:]
    apart = np.abs(smooth[3:] + smooth[2:-1] - smooth[1:-2] - smooth[:-3]) / 2
    change[1:-2] = np.where(inner, np.minimum(apart / LIMITS.edge_step, 1), 0)
    return np.where(change == cv2.dilate(change, np.ones((3, 1), np.uint8)), change, 0).astype(np.float32)


def _mean(pictures: Sequence[F32], masks: Sequence[Bools]) -> F32:
    """Mean (H, W) over the photos that see each texel; 0 where none does."""
    weight = np.stack(masks).astype(np.float32)
    return np.asarray((np.stack(pictures) * weight).sum(axis=0) / np.maximum(weight.sum(axis=0), 1), np.float32)


def _reference_level(light: F32, wall: Wall) -> F32:
    """Grey level (1, W) of the scanned wall below its top, per column of texels, smoothed along the wall."""
    rows = np.arange(len(wall.known))[:, None]
    near = wall.known & (rows > wall.ends - REFERENCE_HEIGHT_M / wall.cell)
    weight = np.kron(near, np.ones((TEXELS_PER_CELL, TEXELS_PER_CELL))) * (light > 0)
    sigma = WINDOW_M / wall.cell * TEXELS_PER_CELL
    total = cv2.GaussianBlur(weight.sum(axis=0, keepdims=True), (0, 0), sigmaX=sigma, sigmaY=0.1)
    value = cv2.GaussianBlur((weight * light).sum(axis=0, keepdims=True), (0, 0), sigmaX=sigma, sigmaY=0.1)
    return np.where(total > 1e-3, value / np.maximum(total, 1e-3), -1000).astype(np.float32)


def _box(image: F32, window: int) -> F32:
    return np.asarray(cv2.blur(image, (window, window), borderType=cv2.BORDER_CONSTANT), np.float32)


def _cells(texels: F32) -> F32:
    """Means (R, C) of the texels of each cell."""
    rows, columns = (n // TEXELS_PER_CELL for n in texels.shape)
    return np.asarray(texels.reshape(rows, TEXELS_PER_CELL, columns, TEXELS_PER_CELL).mean(axis=(1, 3)), np.float32)
