"""First splats: pixels of the photos at their depth, and the background at infinity."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scan2sim.pipeline.camera.models import pixel_angle
from scan2sim.pipeline.core.splats import Splats
from scan2sim.pipeline.core.types import F32, F64, I64, Bools
from scan2sim.texturing.backdrop.photos import FARTHEST_M, Photo, fill
from scan2sim.texturing.splats.background import HEIGHT_PX, WIDTH_PX, Background
from scan2sim.texturing.splats.shots import Shot

STRIDE_PX = 2
"""Pixels of a prepared photo between samples: of four, one becomes a splat."""
NEAREST_M = 1.0
SCALE, FLATNESS = 0.55, 0.25
"""Standard deviation of a splat relative to the distance of samples, and that along its normal relative to it."""
OPACITY = 0.73
MAX_STEP = 0.1
"""Relative change of depth between neighbouring pixels up to which they are of one surface."""
MIN_SKY_SHARE = 0.2
"""Share of the photos of a direction that must show sky there: a white wall that passes isn't sky."""
DARK_SIGMA_PX = 12.0
"""Blur of the background behind what is not sky: a gap between leaves shows a dark colour."""


def first_splats(photos: Sequence[Photo]) -> tuple[Splats, F32]:
    """Splats at the surfaces that photos show, of several at a place the finest; and their sizes (N,) in metres.

    Args:
        photos: with known depth, or inverse depth by `plane_sweep`.
    """
    parts = [_samples(photo) for photo in photos]
    xyz, normal, rgb, size, scanned = (np.concatenate(column) for column in zip(*parts, strict=True))
    kept = _finest(xyz, size)
    xyz, normal, rgb, size, scanned = xyz[kept], normal[kept], rgb[kept], size[kept], scanned[kept]
    scale = np.repeat(SCALE * size[:, None], 3, axis=1)
    scale[scanned, 2] *= FLATNESS
    made = Splats.of(xyz, scale, _turning_z_to(normal), np.full(len(xyz), OPACITY), np.clip(rgb, 0, 1))
    return made, size.astype(np.float32)


def first_background(shots: Sequence[Shot]) -> Background:
    """The sky that photos show; where they show something else, the blurred colour of that."""
    import cv2

    total, count = np.zeros((2, HEIGHT_PX * WIDTH_PX, 3)), np.zeros((2, HEIGHT_PX * WIDTH_PX))
    for shot in shots:
        level = shot.levels[-1]
        column = np.rint(level.texels[..., 0]).astype(np.int64) % WIDTH_PX
        row = np.clip(np.rint(level.texels[..., 1]).astype(np.int64), 0, HEIGHT_PX - 1)
        index = row * WIDTH_PX + column
        used = level.weight > 0
        for k, chosen in enumerate((used & level.sky, used & ~level.sky)):
            at = index[chosen]
            count[k] += np.bincount(at, minlength=HEIGHT_PX * WIDTH_PX)
            for channel in range(3):
                weights = level.rgb[chosen][:, channel]
                total[k, :, channel] += np.bincount(at, weights, HEIGHT_PX * WIDTH_PX)
    shape = (HEIGHT_PX, WIDTH_PX)
    colour = (total / np.maximum(count, 1)[..., None]).astype(np.float32).reshape(2, *shape, 3)
    votes = count.reshape(2, *shape)
    is_sky = votes[0] > MIN_SKY_SHARE * votes.sum(axis=0)
    scenery = cv2.GaussianBlur(fill(colour[1], votes[1] > 0), (0, 0), DARK_SIGMA_PX)
    known = votes.sum(axis=0) > 0
    return Background(np.clip(fill(np.where(is_sky[..., None], colour[0], scenery), known), 0, 1))


def _samples(photo: Photo) -> tuple[F64, F64, F32, F64, Bools]:
    """Positions, normals, colours, sizes and whether they were scanned, of every `STRIDE_PX`th pixel of a photo."""
    distance = np.where(np.isfinite(photo.known), photo.known, 1 / np.maximum(photo.inverse, 1 / FARTHEST_M))
    points = photo.view.centre + photo.rays * distance[..., None]
    normal, is_surface = _normals(points, distance, photo.view.centre)
    usable = ~photo.sky & ~photo.movable & (distance > NEAREST_M) & (distance < FARTHEST_M)
    at = np.zeros(usable.shape, bool)
    at[STRIDE_PX // 2 :: STRIDE_PX, STRIDE_PX // 2 :: STRIDE_PX] = True
    at &= usable & np.isfinite(points).all(axis=-1)
    size = distance * pixel_angle(photo.camera) * STRIDE_PX
    scanned = np.isfinite(photo.known) & is_surface
    return points[at], normal[at], (photo.levels[at] / 255).astype(np.float32), size[at], scanned[at]


def _normals(points: F64, distance: F64, centre: F64) -> tuple[F64, Bools]:
    """Unit normals (H, W, 3) towards the camera, from neighbouring pixels; and where these are of one surface."""
    across, down = np.gradient(points, axis=1), np.gradient(points, axis=0)
    normal = np.cross(across, down)
    length = np.linalg.norm(normal, axis=-1)
    step = np.maximum(*(np.abs(np.gradient(distance, axis=k)) for k in (0, 1))) / distance
    smooth = (step < MAX_STEP) & (length > 1e-9)
    towards = centre - points
    towards = towards / np.maximum(np.linalg.norm(towards, axis=-1, keepdims=True), 1e-9)
    normal = np.where(smooth[..., None], normal / np.maximum(length, 1e-9)[..., None], towards)
    flipped = (normal * towards).sum(axis=-1) < 0
    return np.where(flipped[..., None], -normal, normal), smooth


def _finest(xyz: F64, size: F64) -> I64:
    """Indices of samples: in cells of about their size, none where there is a finer one."""
    level = np.round(np.log2(size)).astype(int)
    occupied: dict[int, list[I64]] = {}
    kept = []
    for one in range(level.min(), level.max() + 1):
        index = np.flatnonzero(level == one)
        key = _cell(xyz[index], one)
        key, first = np.unique(key, return_index=True)
        index = index[first]
        if one in occupied:
            free = ~np.isin(key, np.concatenate(occupied[one]))
            index = index[free]
        kept.append(index)
        for coarser in range(one, level.max() + 1):
            occupied.setdefault(coarser, []).append(np.unique(_cell(xyz[index], coarser)))
    return np.concatenate(kept)


def _cell(xyz: F64, level: int) -> I64:
    """Keys (N,) of the cubes of 2^level metres that contain points."""
    cell = np.floor(xyz / 2.0**level).astype(np.int64) + (1 << 20)
    return (cell[:, 0] << 42) | (cell[:, 1] << 21) | cell[:, 2]


def _turning_z_to(normal: F64) -> F64:
    """Unit quaternions (N, 4) w x y z that turn the z axis to unit vectors (N, 3)."""
    up = np.where(normal[:, 2:] < 0, -normal, normal)  # a splat is symmetrical
    made = np.column_stack([1 + up[:, 2], -up[:, 1], up[:, 0], np.zeros(len(up))])
    return made / np.linalg.norm(made, axis=1, keepdims=True)
