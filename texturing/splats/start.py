"""First splats: pixels of the photos at their depth, and the background at infinity."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scan2sim.pipeline.camera.models import pixel_angle
from scan2sim.pipeline.core.splats import MAX_COLOUR, MIN_COLOUR, SplatLayer, Splats
from scan2sim.pipeline.core.types import F32, F64, I64, Bools
from scan2sim.texturing.backdrop.photos import FARTHEST_M, Photo, fill
from scan2sim.texturing.splats.background import HEIGHT_PX, WIDTH_PX, Background
from scan2sim.texturing.splats.shots import Shot

STRIDE_PX = 4.5
"""Pixels of a photo, as it is trained on, between samples that become splats."""
NEAREST_M = 1.0
SCALE, FLATNESS = 0.51, 0.25
"""Standard deviation of a splat relative to the distance of samples, and that along its normal relative to it."""
OPACITY = 0.73
MAX_BEND = 0.02
"""Second difference of the inverse depth of neighbouring pixels, relative to it, up to which they are of one surface:
inverse depth is linear over a plane."""
MIN_SKY_SHARE = 0.2
"""Share of the photos of a direction that must show sky there: a white wall that passes isn't sky."""
DARK_SIGMA_DEG = 1.7
"""Blur of the background behind what is not sky: a gap between leaves shows a dark colour."""


def first_splats(photos: Sequence[Photo], inverse: Sequence[F32], excluded: Sequence[Bools]) -> tuple[Splats, F32]:
    """Splats at the surfaces that photos show, of several at a place the finest; and their sizes (N,) in metres.

    Args:
        photos: prepared photos.
        inverse: (H, W) inverse distances along their rays (`depth.inverse_depths`).
        excluded: (H, W) their pixels that aren't used.
    """
    parts = [_samples(*one) for one in zip(photos, inverse, excluded, strict=True)]
    xyz, normal, rgb, size, scanned = (np.concatenate(column) for column in zip(*parts, strict=True))
    if not len(xyz):
        return SplatLayer.nothing().splats, np.zeros(0, np.float32)
    kept = _finest(xyz, size)
    xyz, normal, rgb, size, scanned = xyz[kept], normal[kept], rgb[kept], size[kept], scanned[kept]
    scale = np.repeat(SCALE * size[:, None], 3, axis=1)
    scale[scanned, 2] *= FLATNESS
    rgb = np.clip(rgb, MIN_COLOUR, MAX_COLOUR)
    made = Splats.of(xyz, scale, _turning_z_to(normal), np.full(len(xyz), OPACITY), rgb)
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
        colours = level.exposed.world(level.rgb)
        for k, chosen in enumerate((level.used & level.sky, level.used & ~level.sky)):
            at = index[chosen]
            count[k] += np.bincount(at, minlength=HEIGHT_PX * WIDTH_PX)
            for channel in range(3):
                weights = colours[chosen][:, channel]
                total[k, :, channel] += np.bincount(at, weights, HEIGHT_PX * WIDTH_PX)
    shape = (HEIGHT_PX, WIDTH_PX)
    colour = (total / np.maximum(count, 1)[..., None]).astype(np.float32).reshape(2, *shape, 3)
    votes = count.reshape(2, *shape)
    is_sky = votes[0] > MIN_SKY_SHARE * votes.sum(axis=0)
    scenery = cv2.GaussianBlur(fill(colour[1], votes[1] > 0), (0, 0), DARK_SIGMA_DEG * WIDTH_PX / 360)
    known = votes.sum(axis=0) > 0
    return Background(np.clip(fill(np.where(is_sky[..., None], colour[0], scenery), known), MIN_COLOUR, MAX_COLOUR))


def _samples(photo: Photo, inverse: F32, excluded: Bools) -> tuple[F64, F64, F32, F64, Bools]:
    """Positions, normals, colours, sizes and whether they were scanned, of pixels of a photo on a grid."""
    distance = 1 / np.maximum(inverse, 1e-6).astype(np.float64)
    points = photo.view.centre + photo.rays * distance[..., None]
    normal, is_surface = _normals(points, inverse, photo.view.centre)
    usable = ~photo.sky & ~excluded & (distance > NEAREST_M) & (inverse > 1 / FARTHEST_M)
    stride = max(1, round(STRIDE_PX * photo.camera.width / photo.raw.shape[1]))
    at = np.zeros(usable.shape, bool)
    at[stride // 2 :: stride, stride // 2 :: stride] = True
    at &= usable & np.isfinite(points).all(axis=-1)
    size = distance * pixel_angle(photo.camera) * stride
    scanned = np.isfinite(photo.known) & is_surface
    return points[at], normal[at], (photo.levels[at] / 255).astype(np.float32), size[at], scanned[at]


def _normals(points: F64, inverse: F32, centre: F64) -> tuple[F64, Bools]:
    """Unit normals (H, W, 3) towards the camera, from neighbouring pixels; and where these are of one surface."""
    across, down = np.gradient(points, axis=1), np.gradient(points, axis=0)
    normal = np.cross(across, down)
    length = np.linalg.norm(normal, axis=-1)
    bends = [np.abs(np.gradient(np.gradient(inverse, axis=k), axis=k)) for k in (0, 1)]
    smooth = (np.maximum(*bends) < MAX_BEND * inverse) & (length > 1e-9)
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
