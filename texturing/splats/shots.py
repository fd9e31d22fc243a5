"""Photos as training needs them: images of pinhole cameras, in three sizes, with sky, masks and known depth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F32, F64, U8, Bools, Camera
from scan2sim.texturing.backdrop.photos import Photo
from scan2sim.texturing.photo_cache import camera_of
from scan2sim.texturing.splats.background import texels
from scan2sim.texturing.splats.exposure import Response, falloff
from scan2sim.texturing.splats.loss import CLIPPED_HIGH
from scan2sim.texturing.splats.projection import Pinhole

SCALES = (4, 2, 1)
"""Divisors of the photo's size, coarse to fine."""
WHOLE = 0.99
"""Least share of a reduced pixel that must be usable."""
MOST = 0.5
"""Share of a reduced pixel above which it is sky, or clipped."""
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
        rgb: (H, W, 3) grey levels as the photo has them; 255 in a reduced size where most of them are clipped, as
            their mean would look like a colour.
        exposed: how it shows colours of the world by its exposure.
        used: (H, W) pixels that are compared.
        sky: (H, W) sky.
        known: (H, W) depth along the optical axis in metres, where scan or surface give it, else 0.
        texels: (H, W, 2) texels of the background.
    """

    camera: Pinhole
    rgb: U8
    exposed: Response
    used: Bools
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
        rgb, used, sky: as in `Level`, in full size; `used` (H, W) excludes vehicles, people, masks.
        exposure: (5,) correction of the photo (`photo_cache.Exposures.of`).
        vignetting: (H, W) or (1, 1) of the pixels (`exposure.Response`).
        inverse: (H, W) inverse distance along the ray, 1/metres, where scan or surface give it, else 0.
        axis: (3,) optical axis of the whole photo; 0 for panoramas, which have none.
        taken_by: name of the camera of the whole photo (`photo_cache.camera_of`).
    """

    name: str
    camera: Camera
    T_world_cam: F64
    rgb: U8
    used: Bools
    sky: Bools
    exposure: F64
    vignetting: F32
    inverse: F32
    axis: F64
    taken_by: str

    @cached_property
    def levels(self) -> tuple[Level, ...]:
        """The shot in the sizes of `SCALES`."""
        return tuple(self._level(scale) for scale in SCALES)

    def _level(self, scale: int) -> Level:
        import cv2

        camera = self.camera.resized(-(-self.camera.width // scale), -(-self.camera.height // scale))
        size = (camera.width, camera.height)

        def reduced(image: F32) -> F32:
            return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA) if scale > 1 else image, np.float32)

        def whole(mask: Bools, least: float) -> Bools:
            return reduced(mask.astype(np.float32)) > least if scale > 1 else mask

        x, y = np.meshgrid((np.arange(camera.width) - camera.cx) / camera.fx,
                           (np.arange(camera.height) - camera.cy) / camera.fy)  # fmt: skip
        rays = np.stack([x, y, np.ones_like(x)], axis=-1)
        # the mean of inverse distances is that in the middle, as they are linear over a plane
        known = whole(self.inverse > 0, WHOLE)
        along = reduced(self.inverse) * np.linalg.norm(rays, axis=-1)
        same = self.vignetting.shape == (1, 1)
        rgb = self.rgb
        if scale > 1:
            rgb = np.asarray(cv2.resize(self.rgb, size, interpolation=cv2.INTER_AREA))
            rgb[reduced((self.rgb >= CLIPPED_HIGH).astype(np.float32)) > MOST] = 255
        return Level(
            Pinhole.of(camera, self.T_world_cam),
            rgb,
            Response.of(self.exposure, self.vignetting if same else reduced(self.vignetting)),
            whole(self.used, WHOLE),
            whole(self.sky, MOST),
            np.where(known, 1 / np.maximum(along, 1e-6), 0).astype(np.float32),
            texels(rays @ self.T_world_cam[:3, :3].T),
        )


def shots(photo: Photo, excluded: Bools, scanned: F32) -> Iterator[Shot]:
    """A prepared photo as shots: one, or the faces of a cube for panoramas and wide lenses.

    Args:
        photo: the photo.
        excluded: (H, W) its pixels that aren't used, at the size of `photo.camera`.
        scanned: (h, w) its depth map in any size: metres along the rays, inf where nothing was scanned.
    """
    whole = _whole(photo, excluded, scanned)
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
        masks = (whole.used, whole.sky, whole.inverse > 0)
        used, sky, known = (_sampled(one.astype(np.float32), x, y, wrap) for one in masks)
        same = whole.vignetting.shape == (1, 1)
        yield replace(
            whole, camera=camera, T_world_cam=pose, rgb=_sampled(whole.rgb, x, y, wrap), used=(used > WHOLE) & inside,
            sky=(sky > 0.5) & inside, vignetting=whole.vignetting if same else _sampled(whole.vignetting, x, y, wrap),
            inverse=np.where((known > WHOLE) & inside, _sampled(whole.inverse, x, y, wrap), np.float32(0)),
        )  # fmt: skip


def _whole(photo: Photo, excluded: Bools, scanned: F32) -> Shot:
    """The photo in its own projection, at the size of its texture."""
    import cv2

    height, width = photo.raw.shape[:2]
    size = (width, height)

    def enlarged(mask: Bools) -> Bools:
        return np.asarray(cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0)

    camera = photo.view.camera.resized(width, height)
    a, b = photo.exposure[3:].tolist()
    raw = np.require(photo.raw, np.uint8, ["C", "W"])  # otherwise numba would compile kernels for arrays of its kind
    pose = np.asarray(photo.view.T_world_cam, np.float64)
    return Shot(
        photo.view.name, camera, pose, raw, ~enlarged(excluded), photo.texture_sky, photo.exposure,
        falloff(a, b, height, width), known_inverse(photo, scanned),
        np.zeros(3) if camera.model == "equirectangular" else pose[:3, 2], camera_of(photo.view),
    )  # fmt: skip


def known_inverse(photo: Photo, scanned: F32) -> F32:
    """(H, W) inverse distances, 1/metres, along the rays of a prepared photo's `raw`, 0 where none is known.

    Where it was scanned, those of the depth map, otherwise those of the surface; none at edges.

    Args:
        photo: the photo.
        scanned: (h, w) its depth map in any size.
    """
    height, width = photo.raw.shape[:2]
    scan, surface = (_resized_inverse(one, width, height) for one in (scanned, photo.known))
    return np.where(scan > 0, scan, surface)


def _resized_inverse(distance: F32, width: int, height: int) -> F32:
    """Inverse of distances (h, w), inf where none is known, in another size; 0 where none is known, and at edges."""
    import cv2

    around = np.ones((3, 3), np.uint8)
    least, most = cv2.erode(distance, around), cv2.dilate(distance, around)
    known = np.isfinite(most) & (most / MAX_STEP < least)
    inverse = np.where(known, 1 / np.maximum(distance, 1e-3), 0).astype(np.float32)
    smaller = width < distance.shape[1]
    how = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
    share, mean = (cv2.resize(one, (width, height), interpolation=how) for one in (known.astype(np.float32), inverse))
    return np.where(share > WHOLE, mean, 0).astype(np.float32)


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


def _sampled(image: npt.NDArray[Any], x: F32, y: F32, wrap: bool) -> npt.NDArray[Any]:
    """An image at pixels (H, W)."""
    import cv2

    border = cv2.BORDER_WRAP if wrap else cv2.BORDER_REPLICATE
    return np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=border), image.dtype)
