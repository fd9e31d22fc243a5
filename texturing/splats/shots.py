"""Photos as training needs them: images of pinhole cameras, in three sizes, with weights and sky."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from scan2sim.pipeline.core.types import F32, F64, Bools, Camera
from scan2sim.texturing.backdrop.photos import CLIPPED_LEVEL, Photo
from scan2sim.texturing.splats.background import texels
from scan2sim.texturing.splats.projection import Pinhole

SCALES = (4, 2, 1)
"""Divisors of the photo's size, coarse to fine."""
WHOLE = 0.99
"""Least share of a reduced pixel that must be usable."""
WIDE_MODELS = ("equirectangular", "fisheye")
FACE_ROTATIONS = tuple(
    np.array(rows, float).T
    for rows in (
        ((1, 0, 0), (0, 1, 0), (0, 0, 1)), ((0, 0, -1), (0, 1, 0), (1, 0, 0)), ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
        ((0, 0, 1), (0, 1, 0), (-1, 0, 0)), ((1, 0, 0), (0, 0, 1), (0, -1, 0)), ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    )
)  # fmt: skip
"""Rotations from the axes of the six faces of a cube (front, right, back, left, up, down) to the camera's."""
MAX_STEP = 1.1
"""Ratio of the distances of neighbouring pixels from which these are at an edge, where distances are uncertain."""
MIN_FACE_SHARE = 0.05
"""Faces of which the photo shows less are left out."""


@dataclass(frozen=True)
class Level:
    """A shot in one size.

    Attributes:
        camera: for the rasterizer.
        rgb: (H, W, 3) sRGB 0 to 1 after the exposure correction.
        clipped: (H, W, 3) overexposed channels: the scene is at least as bright.
        weight: (H, W) 1 where the photo is used, else 0.
        sky: (H, W) sky.
        known: (H, W) depth along the optical axis in metres, where scan or surface give it, else 0.
        texels: (H, W, 2) texels of the background.
    """

    camera: Pinhole
    rgb: F32
    clipped: Bools
    weight: F32
    sky: Bools
    known: F32
    texels: F32


@dataclass(frozen=True)
class Shot:
    """A photo, or a part of it that a pinhole camera sees.

    Attributes:
        name: name of the photo.
        camera: its model is "pinhole".
        T_world_cam: (4, 4) its pose.
        rgb, clipped, usable, sky: as in `Level`, in full size; `usable` (H, W) excludes vehicles, people, masks.
        distance: (H, W) metres along the ray, where scan or surface give it, else 0.
    """

    name: str
    camera: Camera
    T_world_cam: F64
    rgb: F32
    clipped: Bools
    usable: Bools
    sky: Bools
    distance: F32

    @cached_property
    def levels(self) -> tuple[Level, ...]:
        """The shot in the sizes of `SCALES`."""
        return tuple(self._level(scale) for scale in SCALES)

    def _level(self, scale: int) -> Level:
        import cv2

        camera = self.camera.resized(-(-self.camera.width // scale), -(-self.camera.height // scale))

        def reduced(image: F32) -> F32:
            size = (camera.width, camera.height)
            return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA) if scale > 1 else image, np.float32)

        x, y = np.meshgrid((np.arange(camera.width) - camera.cx) / camera.fx,
                           (np.arange(camera.height) - camera.cy) / camera.fy)  # fmt: skip
        rays = np.stack([x, y, np.ones_like(x)], axis=-1)
        distance = cv2.resize(self.distance, (camera.width, camera.height), interpolation=cv2.INTER_NEAREST)
        return Level(
            Pinhole.of(camera, self.T_world_cam),
            reduced(self.rgb),
            reduced(self.clipped.astype(np.float32)) > 0.5,
            (reduced(self.usable.astype(np.float32)) > WHOLE).astype(np.float32),
            reduced(self.sky.astype(np.float32)) > 0.5,
            (distance / np.linalg.norm(rays, axis=-1)).astype(np.float32),
            texels(rays @ self.T_world_cam[:3, :3].T),
        )


def shots(photo: Photo, excluded: Bools) -> Iterator[Shot]:
    """A prepared photo as shots: one, or the faces of a cube for panoramas and wide lenses.

    Args:
        photo: the photo.
        excluded: (H, W) its pixels that aren't used, at the size of `photo.camera`.
    """
    whole = _whole(photo, excluded)
    if photo.view.camera.model == "pinhole":
        yield whole
        return
    for camera, rotation in _pinholes(whole.camera):
        x, y, inside = _lookup(whole.camera, camera, rotation)
        if inside.mean() < MIN_FACE_SHARE:
            continue
        pose = whole.T_world_cam.copy()
        pose[:3, :3] = pose[:3, :3] @ rotation
        wrap = whole.camera.model == "equirectangular"
        colour = _sampled(whole.rgb, x, y, wrap)
        masks = [_sampled(one.astype(np.float32), x, y, wrap) for one in (whole.clipped, whole.usable, whole.sky)]
        yield replace(
            whole, camera=camera, T_world_cam=pose, rgb=colour, clipped=masks[0] > 0.5,
            usable=(masks[1] > WHOLE) & inside, sky=(masks[2] > 0.5) & inside,
            distance=_nearest(whole.distance, x, y, wrap) * inside,
        )  # fmt: skip


def _whole(photo: Photo, excluded: Bools) -> Shot:
    """The photo in its own projection, at the size of its texture."""
    import cv2

    height, width = photo.texture.shape[:2]
    size = (width, height)

    def enlarged(mask: Bools) -> Bools:
        return np.asarray(cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0)

    camera = photo.view.camera.resized(width, height)
    rgb = (photo.texture / 255).astype(np.float32)
    return Shot(
        photo.view.name, camera, np.asarray(photo.view.T_world_cam, np.float64), rgb,
        photo.texture_clipped | (photo.texture >= CLIPPED_LEVEL), ~enlarged(excluded), photo.texture_sky,
        np.asarray(cv2.resize(known_distance(photo), size, interpolation=cv2.INTER_NEAREST)),
    )  # fmt: skip


def known_distance(photo: Photo) -> F32:
    """(H, W) metres along the rays of a prepared photo, where scan or surface give them, 0 elsewhere and at edges."""
    import cv2

    around = np.ones((3, 3), np.uint8)
    least, most = cv2.erode(photo.known, around), cv2.dilate(photo.known, around)
    return np.where(np.isfinite(most) & (most / MAX_STEP < least), photo.known, 0).astype(np.float32)


def _pinholes(camera: Camera) -> list[tuple[Camera, F64]]:
    """Pinhole cameras that together see what a camera sees, and their rotations to its axes."""
    if camera.model not in WIDE_MODELS:
        return [(Camera("pinhole", camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy), np.eye(3))]
    focal = camera.fx if camera.model == "fisheye" else camera.width / (2 * np.pi)
    side = 2 * round(focal)
    face = Camera("pinhole", side, side, side / 2, side / 2, (side - 1) / 2, (side - 1) / 2)
    return [(face, rotation) for rotation in FACE_ROTATIONS]


def _lookup(camera: Camera, pinhole: Camera, rotation: F64) -> tuple[F32, F32, Bools]:
    """Pixels (H, W) of a camera at the pixels of a pinhole camera, and whether they are inside its image."""
    from scan2sim.pipeline.camera.projection import pixels

    x, y = np.meshgrid((np.arange(pinhole.width) - pinhole.cx) / pinhole.fx,
                       (np.arange(pinhole.height) - pinhole.cy) / pinhole.fy)  # fmt: skip
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ rotation.T
    uv, inside = pixels(camera, np.eye(4), rays.reshape(-1, 3))
    return uv[:, 0].reshape(x.shape), uv[:, 1].reshape(x.shape), inside.reshape(x.shape)


def _sampled(image: F32, x: F32, y: F32, wrap: bool) -> F32:
    import cv2

    border = cv2.BORDER_WRAP if wrap else cv2.BORDER_REPLICATE
    return np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=border), np.float32)


def _nearest(image: F32, x: F32, y: F32, wrap: bool) -> F32:
    import cv2

    border = cv2.BORDER_WRAP if wrap else cv2.BORDER_REPLICATE
    return np.asarray(cv2.remap(image, x, y, cv2.INTER_NEAREST, borderMode=border), np.float32)
