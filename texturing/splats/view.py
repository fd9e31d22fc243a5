"""Views of trained splats through any camera: colour, depth and cover."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.splats import SplatLayer
from scan2sim.pipeline.core.types import F32, F64, U8, Bools, Camera
from scan2sim.texturing.splats import backends
from scan2sim.texturing.splats.background import Background, texels
from scan2sim.texturing.splats.exposure import of_nearest
from scan2sim.texturing.splats.projection import Pinhole
from scan2sim.texturing.splats.shots import FACE_ROTATIONS

FACE_DENSITY = 1.1
"""Pixels of the pinhole images per pixel in the middle of another lens, along a line."""
KEPT_CAMERAS = 16
"""Cameras of which rays are kept between views."""
WIDEST = 1.5
"""Slope of rays up to which one pinhole image is used for a lens."""


@dataclass(frozen=True)
class SplatImage:
    """A view of splats; arrays are (H, W).

    Attributes:
        rgb: (H, W, 3) uint8.
        range: metres along the ray to where half of the light is stopped (median), inf where more than half is the
            background's.
        cover: 0 to 1, 1 less the share of the background.
    """

    rgb: U8
    range: F32
    cover: F32


class SplatRenderer:
    """Renders a layer of splats.

    Args:
        layer: the splats.
        backend: what renders (`backends.choose`).

    Raises:
        SettingError, UnavailableError: there is no such backend, or it can't run here.

    Attributes:
        behind: backgrounds and their shares, which add up to 1; at first that of the layer.
    """

    def __init__(self, layer: SplatLayer, backend: str = backends.AUTO) -> None:
        self._scene = backends.choose(backend).scene(layer.splats.parameters)
        self.behind = [(Background(layer.background), 1.0)]
        self._photos, self._cameras = layer.photos, layer.cameras

    def view(self, camera: Camera, T_world_cam: F64, *, as_photo: str | None = None) -> SplatImage:
        """Render the view of a camera with the pose `T_world_cam` (4, 4).

        Args:
            camera: any perspective camera.
            T_world_cam: its pose.
            as_photo: name of a camera (`photo_cache.camera_of`): with the exposure and vignetting of its nearest photos
                in the training, or, if it took none, with the exposure of the nearest photos; None: with the world's.

        Raises:
            SettingError: the camera is orthographic.
        """
        if camera.model == "orthographic":
            raise SettingError("camera", "splats have no orthographic views", "Use a perspective camera, or surfaces")
        if camera.model == "pinhole":
            colour, distance, cover = self._pinhole(camera, T_world_cam)
        else:
            colour, distance, cover = self._resampled(camera, T_world_cam)
        if as_photo is not None:
            index = self._cameras.index(as_photo) if as_photo in self._cameras else None
            colour = of_nearest(self._photos, T_world_cam, camera.height, camera.width, index).shown(colour)
        levels = np.clip(np.rint(colour * 255), 0, 255).astype(np.uint8)
        return SplatImage(levels, distance, cover)

    def _pinhole(self, camera: Camera, T_world_cam: F64) -> tuple[F32, F32, F32]:
        """Colour, range and cover of a pinhole view."""
        rays, length = _rays(camera)
        drawn = self._scene.render(Pinhole.of(camera, T_world_cam))
        at = texels(rays @ T_world_cam[:3, :3].T.astype(np.float32))
        behind = [np.float32(share) * background.seen(at) for background, share in self.behind]
        colour = drawn.over(np.asarray(sum(behind[1:], start=behind[0]), np.float32))
        return colour, np.asarray(drawn.depth * length, np.float32), 1 - drawn.transmittance

    def _resampled(self, camera: Camera, T_world_cam: F64) -> tuple[F32, F32, F32]:
        """The same of other cameras: each pixel from the pinhole image that its ray passes."""
        import cv2

        found = np.zeros((camera.height, camera.width, 5), np.float32)
        found[..., 4] = np.inf
        for pinhole, rotation, x, y, through in _parts(camera):
            pose = np.asarray(T_world_cam, np.float64).copy()
            pose[:3, :3] = pose[:3, :3] @ rotation
            colour, distance, cover = self._pinhole(pinhole, pose)
            smooth = cv2.remap(np.dstack([colour, cover]), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            # nothing is at the mean distance of what is before and behind an edge
            nearest = cv2.remap(distance, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
            found[through] = np.dstack([smooth, nearest])[through]
        return found[..., :3], found[..., 4], found[..., 3]


@lru_cache(KEPT_CAMERAS)
def _rays(camera: Camera) -> tuple[F32, F32]:
    """(H, W, 3) rays of a pinhole camera, 1 m ahead, and their lengths (H, W)."""
    x, y = np.meshgrid((np.arange(camera.width) - camera.cx) / camera.fx,
                       (np.arange(camera.height) - camera.cy) / camera.fy)  # fmt: skip
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).astype(np.float32)
    return rays, np.asarray(np.linalg.norm(rays, axis=-1), np.float32)


@lru_cache(KEPT_CAMERAS)
def _parts(camera: Camera) -> list[tuple[Camera, F64, F32, F32, Bools]]:
    """Pinhole cameras that together see what a camera sees.

    Returns:
        for each its rotation to the camera's axes, its pixels (H, W) of the camera's rays, and where they are inside.
    """
    from scan2sim.pipeline.camera.models import pixel_angle, pixel_rays

    rays = pixel_rays(camera).astype(np.float64)
    seen = np.isfinite(rays).all(axis=-1)
    rays = np.nan_to_num(rays)
    parts = []
    for pinhole, rotation in _pinholes(rays[seen], FACE_DENSITY / pixel_angle(camera)):
        own = rays @ rotation
        x, y = (own[..., k] / np.maximum(own[..., 2], 1e-9) for k in (0, 1))
        x, y = x * pinhole.fx + pinhole.cx, y * pinhole.fy + pinhole.cy
        inside = seen & (own[..., 2] > 0) & (np.abs(x - (pinhole.width - 1) / 2) <= pinhole.width / 2)
        inside &= np.abs(y - (pinhole.height - 1) / 2) <= pinhole.height / 2
        if inside.any():
            parts.append((pinhole, rotation, x.astype(np.float32), y.astype(np.float32), inside))
    return parts


def _pinholes(rays: F64, focal: float) -> list[tuple[Camera, F64]]:
    """Pinhole cameras that together see rays (N, 3), and their rotations to the rays' axes.

    One, as wide as the rays, if none is farther than `atan(WIDEST)` from the optical axis, else the faces of a cube.
    """
    ahead = rays[:, 2] > 0
    slope = rays[:, :2] / np.where(ahead, rays[:, 2], 1)[:, None]
    if len(rays) and ahead.all() and np.abs(slope).max() < WIDEST:
        low, high = np.floor(slope.min(axis=0) * focal), np.ceil(slope.max(axis=0) * focal)
        width, height = (high - low + 1).astype(int).tolist()
        return [(Camera("pinhole", width, height, focal, focal, -float(low[0]), -float(low[1])), np.eye(3))]
    side = max(16, round(2 * focal))
    face = Camera("pinhole", side, side, side / 2, side / 2, (side - 1) / 2, (side - 1) / 2)
    return [(face, rotation) for rotation in FACE_ROTATIONS]
