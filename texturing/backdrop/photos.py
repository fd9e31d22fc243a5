"""Photos prepared for the backdrop: pixels without surface, sky, vehicles, and features for matching."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scan2sim.pipeline.core.classes import PHOTO_CLASSES
from scan2sim.pipeline.core.types import F32, F64, U8, Bools, Camera, View
from scan2sim.pipeline.io.images import image
from scan2sim.texturing.photo_cache import SRGB_OFFSET, Exposures, squared_radius

if TYPE_CHECKING:
    from scan2sim.pipeline.camera.renderer import Renderer

MATCHING_PIXELS = 75_000
"""Size of the images in which depth is estimated."""
TEXTURE_PIXELS = 1_000_000
"""Largest size of the images that texture is read from."""
SKY_OUTLINE_TOLERANCE_M = 0.2
SKY_MIN_LEVEL, SKY_SURE_LEVEL, MOVABLE_MIN_LEVEL = 100, 200, 90
"""Probabilities (255 is 1) of the class sky at which pixels of the sky's colour, and all pixels, are sky; and of
vehicles and people."""
CLIPPED_LEVEL = 250
"""Grey level from which a channel is overexposed: the scene is at least as bright."""


@dataclass
class Photo:
    """A photo; arrays are (H, W) at the size of `camera` unless noted.

    Attributes:
        view: posed photo.
        camera: its camera scaled to `MATCHING_PIXELS`.
        rays: (H, W, 3) unit rays in local axes.
        known: distance along the ray in metres to the first surface or scanned point, inf if there is none.
        hit: whether the world has a surface there.
        sky: sky, and nothing scanned.
        movable: vehicles and people.
        levels: (H, W, 3) grey levels after the exposure correction.
        clipped: (H, W, 3) whether a channel was overexposed.
        raw, texture_sky: (h, w, 3) grey levels as the photo has them, and (h, w) sky, in the size that texture is read
            from.
        exposure: (5,) correction of the photo (`Exposures.of`).
        masked: what the photo's mask excludes; part of `movable`.
        inverse: inverse distance along the rays, 1/metres; set by `plane_sweep`.
        wanted: neither surface, nor sky, nor movable, nor scanned: pixels whose depth is to be estimated.
    """

    view: View
    camera: Camera
    rays: F64
    known: F32
    hit: Bools
    sky: Bools
    movable: Bools
    levels: F32
    clipped: Bools
    raw: U8
    texture_sky: Bools
    exposure: F64
    masked: Bools
    inverse: F32 = field(default_factory=lambda: np.zeros((0, 0), np.float32))

    @property
    def wanted(self) -> Bools:
        """See the class."""
        return ~np.isfinite(self.known) & ~self.sky & ~self.movable

    @cached_property
    def texture(self) -> U8:
        """(h, w, 3) grey levels after the exposure correction; what is brighter than white is cut."""
        return np.clip(_corrected(self.raw, self.exposure), 0, 255).astype(np.uint8)

    @property
    def grey(self) -> F32:
        """(H, W) mean of the channels."""
        r, g, b = self.levels[..., 0], self.levels[..., 1], self.levels[..., 2]
        return np.asarray((r + g + b) / np.float32(3), np.float32)

    @cached_property
    def features(self) -> F32:
        """(H, W, 4) channels that are compared: colour, and detail, which differences of exposure don't change."""
        import cv2

        grey = self.grey
        return np.dstack([0.25 * self.levels, grey - cv2.blur(grey, (9, 9))]).astype(np.float32)

    @property
    def points(self) -> F64:
        """(H, W, 3) local positions of the pixels at their estimated depth, at most `FARTHEST_M` away."""
        return self.view.centre + self.rays / np.maximum(self.inverse, 1 / FARTHEST_M)[..., None]


FARTHEST_M = 250.0
"""Depth of what is farther: parallax of a metre is less than a pixel there. Cameras must show as much (`clip`)."""


def prepare(
    view: View,
    depth: Path,
    labels: Path | None,
    world: Renderer,
    exposures: Exposures,
    matching_pixels: int = MATCHING_PIXELS,
) -> Photo | None:
    """Prepare a photo; None if it can't be read.

    Args:
        view: posed photo.
        depth: its depth map (step `visibility`).
        labels: its class probabilities (step `label`), or None: without them vehicles count as scenery.
        world: the world's surfaces.
        exposures: exposure corrections.
        matching_pixels: size of the images in which depth is estimated.
    """
    import cv2

    from scan2sim.pipeline.camera.models import pixel_angle, pixel_rays
    from scan2sim.texturing.sky import sky

    rgb = image.usable_photo(view)
    if rgb is None:
        return None
    full = view.camera.width * view.camera.height
    large = view.camera.scaled(min(1.0, (TEXTURE_PIXELS / full) ** 0.5))
    small = view.camera.scaled(min(1.0, (matching_pixels / full) ** 0.5))
    size = (small.width, small.height)
    if large.width != view.camera.width:
        rgb = np.asarray(cv2.resize(rgb, (large.width, large.height), interpolation=cv2.INTER_AREA), np.uint8)
    exposure = exposures.of(view)
    corrected = _corrected(rgb, exposure)
    rotation = view.T_world_cam[:3, :3]
    rays = np.nan_to_num(pixel_rays(small).astype(np.float64)) @ rotation.T
    rendered = world.view(small, view.T_world_cam)
    scanned = np.load(depth)
    found = sky(rgb, scanned, rays[..., 2].astype(np.float32), pixel_angle(large), SKY_OUTLINE_TOLERANCE_M)
    is_sky: Bools = np.zeros(rgb.shape[:2], bool) if found is None else found
    movable: Bools = np.zeros(rgb.shape[:2], bool)
    if labels is not None and labels.is_file():
        probability = np.load(labels)

        def level(*names: str) -> F32:
            total = sum(probability[..., PHOTO_CLASSES.index(name)].astype(np.float32) for name in names)
            return np.asarray(cv2.resize(total, (rgb.shape[1], rgb.shape[0])), np.float32)

        sky_level = level("sky")
        is_sky = (is_sky & (sky_level > SKY_MIN_LEVEL)) | (sky_level > SKY_SURE_LEVEL)
        movable = np.asarray(level("vehicle", "person") > MOVABLE_MIN_LEVEL)
    allowed = image.read_mask(view)
    masked: Bools = np.zeros(rgb.shape[:2], bool)
    if allowed is not None:
        masked = np.asarray(cv2.resize(allowed, (rgb.shape[1], rgb.shape[0]), interpolation=cv2.INTER_NEAREST) == 0)
    movable |= masked
    movable = np.asarray(cv2.dilate(movable.astype(np.uint8), np.ones((9, 9))) > 0)
    known = np.asarray(cv2.resize(scanned, size, interpolation=cv2.INTER_NEAREST), np.float32)
    known = np.where(rendered.hit, np.minimum(known, rendered.range), known)

    def reduced(mask: Bools) -> Bools:
        return np.asarray(cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5)

    seen = np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA))
    return Photo(
        view, small, rays, known, rendered.hit, reduced(is_sky) & ~np.isfinite(known), reduced(movable),
        np.asarray(cv2.resize(corrected, size, interpolation=cv2.INTER_AREA), np.float32), seen >= CLIPPED_LEVEL,
        rgb, is_sky, exposure, reduced(masked),
    )  # fmt: skip


def choose(views: Sequence[View], usable: Sequence[int], spacing: float, max_photos: int) -> list[int]:
    """Indices of `usable` photos at least `spacing` metres apart (unless they look elsewhere), at most `max_photos`.

    With more, the spacing is larger; if all look elsewhere, they are taken at equal steps. Orthophotos aren't chosen.
    """
    candidates = [k for k in usable if views[k].camera.model != "orthographic"]
    centres = np.array([views[k].centre for k in candidates])
    extent = float(np.linalg.norm(np.ptp(centres, axis=0))) if len(centres) else 0.0
    while True:
        chosen: list[int] = []
        for k in candidates:
            near = (
                np.linalg.norm(views[k].centre - views[c].centre) < 0.95 * spacing
                and views[k].T_world_cam[:3, 2] @ views[c].T_world_cam[:3, 2] > 0.9
                for c in chosen
            )
            if not any(near):
                chosen.append(k)
        if len(chosen) <= max_photos:
            return chosen
        if 0.95 * spacing >= extent:
            return [chosen[n * len(chosen) // max_photos] for n in range(max_photos)]
        spacing = max(1.25 * spacing, extent / 1000)


def _corrected(rgb: U8, exposure: F64) -> F32:
    """Grey levels (H, W, 3) after the correction of exposure and vignetting (`texturing.exposure_model`)."""
    factor = exposure[:3].astype(np.float32)
    if exposure[3:].any():
        q = squared_radius(*rgb.shape[:2])
        factor = factor + (exposure[3] * q + exposure[4] * q * q)[..., None]
    return np.asarray((rgb + np.float32(SRGB_OFFSET)) * np.exp(factor) - np.float32(SRGB_OFFSET), np.float32)


def fill(levels: F32, known: Bools) -> F32:
    """Levels (H, W, C) with unknown pixels filled smoothly from known ones around (push-pull, Gortler et al. 1996)."""
    import cv2

    weight = known.astype(np.float32)[..., None]
    pyramid = [(levels.astype(np.float32), weight)]
    while max(weight.shape) > 1:
        value, weight = pyramid[-1]
        size = ((value.shape[1] + 1) // 2, (value.shape[0] + 1) // 2)
        total, share = (cv2.resize(a, size, interpolation=cv2.INTER_AREA) for a in (value * weight, weight))
        total, share = (a.reshape(size[1], size[0], -1) for a in (total, share))
        weight = np.minimum(4 * share, 1)
        pyramid.append((total / np.maximum(share, 1e-6), weight))
    filled = pyramid[-1][0]
    for value, weight in pyramid[-2::-1]:
        above = cv2.resize(filled, (value.shape[1], value.shape[0]), interpolation=cv2.INTER_LINEAR)
        above = above.reshape(value.shape)
        filled = value * weight + above * (1 - weight)
    return np.asarray(filled, np.float32)
