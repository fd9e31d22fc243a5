"""What photos say of a wall beyond what was scanned of it.

The wall's plane is rectified from photos at several places along the path (Gallup et al., "Real-time plane-sweeping
stereo with multiple sweeping directions", CVPR 2007). What lies on it is alike in all of them; what lies before or
behind does so on a parallel plane. Where there is no pattern to compare, it has to be as the scanned wall below is.
Import late: it loads numba.
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

TEXELS = 2
"""Samples of the photos along a cell's side."""
WINDOW = 0.75
"""Metres of the patches that are compared."""
OFFSETS = (-0.7, 0.7, 1.6, 3.5, 8.0)
"""Metres behind the wall (negative: before it) of other planes that patches are compared on."""
SAME = 0.05
"""Correlation by which another plane must be better to tell against the wall's own."""
VIEWS = 8
"""Photos that a wall is compared in, spread along the path."""
GLANCE = 0.25
"""Texels along a cell's side that decide whether a photo sees the wall at all."""
NEAR = 60.0
"""Metres from which photos are compared."""
FLAT_ON = 0.1
"""Cosine of the angle between the wall's normal and a photo's ray, at least."""
COARSE = 0.25
"""Metres that a pixel may span on the wall."""
OFF = 0.3
"""Metres before the wall from which on something hides it."""
NOISE = 3.0
"""Grey levels, standard deviation in a patch, below which there is no pattern to compare."""
SHARP = 12.0
"""Grey levels by which the picture changes at a sharp edge."""
ALIKE = 25.0
"""Grey levels by which a plain place may differ from the scanned wall below it."""
WHITE = 245.0
"""Grey level from which a plain place may be anything overexposed."""
BELOW = 1.5
"""Metres below the scan's end whose colour that is."""
UNSEEN = -0.1
"""What is said of a place that fewer than two photos see."""


@dataclass(frozen=True)
class Photo:
    """A photo to compare.

    Attributes:
        view: its camera and pose.
        levels: its grey levels, uint8: whole, halved, and halved again.
        usable: (H, W) uint8, 0 where it must not be used; None: everywhere.
        sky: (h, w) uint8, 255 where it surely shows the sky; None: unknown.
        hides: what of the cloud it sees first.
    """

    view: View
    levels: tuple[U8, ...]
    usable: U8 | None
    sky: U8 | None
    hides: DepthMap


@dataclass(frozen=True)
class Patch:
    """A wall's plane as one photo shows it, texel for texel: grey (H, W), where it is seen, and sky from 0 to 1."""

    grey: F32
    seen: Bools
    sky: F32


def rectified(wall: Wall, photo: Photo, offset: float = 0.0, texels: float = TEXELS) -> Patch:
    """A photo rectified to a wall's plane, moved back by `offset` metres.

    Args:
        wall: its rows and columns are sampled.
        photo: to sample.
        offset: metres behind the wall.
        texels: along a cell's side.
    """
    rows, columns = (max(1, round(n * texels)) for n in wall.known.shape)
    r, c = (np.arange(n) for n in (rows, columns))
    places = wall.places(((r + 0.5) / texels - 0.5)[:, None], ((c + 0.5) / texels - 0.5)[None, :])
    flat = places.reshape(-1, 3) - offset * wall.normal
    camera, ray = photo.view.camera, flat - photo.view.centre
    distance = np.linalg.norm(ray, axis=1)
    cos = -(ray @ wall.normal) / np.maximum(distance, 1e-9)
    pixel = distance * pixel_angle(camera)
    seen = (cos > FLAT_ON) & (distance < NEAR) & (pixel < COARSE * cos)
    uv = np.full((len(flat), 2), -1, np.float32)
    if seen.any():
        at = np.flatnonzero(seen)
        uv[at], valid = pixels(camera, photo.view.T_world_cam, flat[at])
        valid[valid] = visible(photo.hides, flat[at[valid]] + OFF * wall.normal)
        seen[at] = valid
    finer = wall.cell / texels / float(np.median(pixel[seen])) if seen.any() else 1.0
    level = int(np.clip(np.log2(max(finer, 1.0)) + 0.3, 0, len(photo.levels) - 1))
    u, v = (uv[:, k].reshape(rows, columns) for k in (0, 1))

    def sampled(picture: npt.NDArray[np.generic]) -> F32:
        fx, fy = picture.shape[1] / camera.width, picture.shape[0] / camera.height
        x, y = (u + 0.5) * fx - 0.5, (v + 0.5) * fy - 0.5
        # by OpenCV, whole pictures of one channel: a quarter of the time that `pipeline.camera.image_sampling` takes
        return np.asarray(cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32)

    seen = seen.reshape(rows, columns)
    if photo.usable is not None:
        seen &= sampled(photo.usable) > 0
    sky = np.zeros((rows, columns), np.float32) if photo.sky is None else sampled(photo.sky) / np.float32(255)
    return Patch(sampled(photo.levels[level]), seen, sky)


def evidence(wall: Wall, photos: Sequence[Photo]) -> tuple[F32, F32]:
    """What photos say of each cell.

    Returns:
        (R, C) above 0 for the wall, below 0 for something else, about -1 to 1; and (R, C) from 0 to 1 how sharply the
        picture changes at the cell's upper side, as it does where a wall ends.
    """
    chosen = [photo for photo in photos if rectified(wall, photo, 0.0, GLANCE).seen.any()]
    chosen = [chosen[round(k)] for k in np.linspace(0, len(chosen) - 1, min(VIEWS, len(chosen)))]
    if len(chosen) < 2:
        return np.full(wall.known.shape, UNSEEN, np.float32), np.zeros(wall.known.shape, np.float32)
    window = 2 * round(WINDOW / 2 / wall.cell * TEXELS) + 1
    own = [rectified(wall, photo) for photo in chosen]
    alike, deep, count = agreement(_alike_bright(own, wall), window)
    elsewhere = np.full_like(alike, -1.0)
    for offset in OFFSETS:
        there, _, many = agreement([rectified(wall, photo, offset) for photo in chosen], window)
        elsewhere = np.maximum(elsewhere, np.where(many >= 2, there, -1.0))
    light = _mean([p.grey for p in _alike_bright(own, wall)], [p.seen for p in own])
    sky = _mean([p.sky for p in own], [p.seen for p in own])
    patterned = np.clip(2 * alike - 1, -0.5, 0.5) - np.clip(4 * (elsewhere - alike - SAME), 0, 1)
    plain = np.where(np.abs(light - _below(light, wall)) < ALIKE, np.where(light < WHITE, 0.05, UNSEEN), -0.4)
    value = np.where(deep > NOISE, patterned, plain) - 1.5 * np.clip(sky - 0.3, 0, 1)
    value = _raised(np.where(count >= 2, value, UNSEEN).astype(np.float32), count >= 2, window // 2)
    return _cells(value), _edges(_cells(light), _cells((count >= 2).astype(np.float32)) == 1)


def agreement(patches: Sequence[Patch], window: int) -> tuple[F32, F32, I32]:
    """How alike the patches around each texel are.

    Returns:
        (H, W) mean correlation with the mean of the others, of those photos that correlate with it; the patches' mean
        standard deviation, grey levels; and how many photos see it.
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
        likeness = np.stack([_box(o * r, window) for o, r in zip(own, rest, strict=True)]) / (length * size)
        likeness = np.where((number - full * support) > 0, likeness, 0)
        support = (likeness > 0.3).astype(np.float32)
    count = full.sum(axis=0)
    supporting = (support * full).sum(axis=0)
    alike = (likeness * support * full).sum(axis=0) / np.maximum(supporting, 1)
    alike = alike * np.minimum(1, supporting / np.maximum(2, 0.5 * count))
    deep = (deviation * full).sum(axis=0) / np.maximum(count, 1)
    return alike.astype(np.float32), deep.astype(np.float32), count.astype(np.int32)


def _alike_bright(patches: Sequence[Patch], wall: Wall) -> list[Patch]:
    """The patches, each as bright as all are where the wall was scanned."""
    known = np.kron(wall.known, np.ones((TEXELS, TEXELS), np.uint8)) > 0
    light = np.array([np.mean(p.grey[known & p.seen]) if (known & p.seen).any() else np.nan for p in patches])
    gain = (
        np.nan_to_num(np.nanmean(light) / np.maximum(light, 1), nan=1.0) if np.isfinite(light).any() else light * 0 + 1
    )
    return [Patch(p.grey * np.float32(g), p.seen, p.sky) for p, g in zip(patches, gain, strict=True)]


def _raised(value: F32, seen: Bools, half: int) -> F32:
    """Each place's value where it is half a patch higher: an edge looks alike in all patches that it is in."""
    up, there = np.roll(value, -half, axis=0), np.roll(seen, -half, axis=0)
    there[-half:] = False
    return np.where(there, up, value)


def _edges(light: F32, seen: Bools) -> F32:
    """(R, C) how sharply grey levels (R, C) change above each cell, 0 to 1; 0 but at the sharpest of three rows."""
    smooth = cv2.blur(light, (5, 1), borderType=cv2.BORDER_REPLICATE)
    change = np.zeros_like(smooth)
    inner = seen[:-3] & seen[1:-2] & seen[2:-1] & seen[3:]
    apart = np.abs(smooth[3:] + smooth[2:-1] - smooth[1:-2] - smooth[:-3]) / 2
    change[1:-2] = np.where(inner, np.minimum(apart / SHARP, 1), 0)
    return np.where(change == cv2.dilate(change, np.ones((3, 1), np.uint8)), change, 0).astype(np.float32)


def _mean(pictures: Sequence[F32], masks: Sequence[Bools]) -> F32:
    """(H, W) mean of what is seen; 0 where nothing is."""
    weight = np.stack(masks).astype(np.float32)
    return np.asarray((np.stack(pictures) * weight).sum(axis=0) / np.maximum(weight.sum(axis=0), 1), np.float32)


def _below(light: F32, wall: Wall) -> F32:
    """(1, W) grey level of the scanned wall below its end, by column of texels, smoothed along the wall."""
    rows = np.arange(len(wall.known))[:, None]
    near = wall.known & (rows > wall.ends - BELOW / wall.cell)
    weight = np.kron(near, np.ones((TEXELS, TEXELS))) * (light > 0)
    sigma = WINDOW / wall.cell * TEXELS
    total = cv2.GaussianBlur(weight.sum(axis=0, keepdims=True), (0, 0), sigmaX=sigma, sigmaY=0.1)
    value = cv2.GaussianBlur((weight * light).sum(axis=0, keepdims=True), (0, 0), sigmaX=sigma, sigmaY=0.1)
    return np.where(total > 1e-3, value / np.maximum(total, 1e-3), -1000).astype(np.float32)


def _box(image: F32, window: int) -> F32:
    return np.asarray(cv2.blur(image, (window, window), borderType=cv2.BORDER_CONSTANT), np.float32)


def _cells(texels: F32) -> F32:
    """(R, C) means of the texels of each cell."""
    rows, columns = (n // TEXELS for n in texels.shape)
    return np.asarray(texels.reshape(rows, TEXELS, columns, TEXELS).mean(axis=(1, 3)), np.float32)
