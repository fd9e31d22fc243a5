"""Views of trained splats through any camera: colour, depth and cover."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2sim.pipeline.core.splats import SplatLayer
from scan2sim.pipeline.core.types import F32, F64, U8, Camera
from scan2sim.texturing.splats import rasterizer
from scan2sim.texturing.splats.background import Background, texels
from scan2sim.texturing.splats.projection import Pinhole
from scan2sim.texturing.splats.shots import FACE_ROTATIONS

FACE_DENSITY = 1.1
"""Pixels of a cube's faces per pixel in the middle of a wide lens, along a line."""
SOLID = 0.5
"""Least cover of a pixel that has a depth."""


@dataclass(frozen=True)
class SplatImage:
    """A view of splats; arrays are (H, W).

    Attributes:
        rgb: (H, W, 3) uint8.
        range: metres along the ray to what covers the pixel (mean, by alpha), inf where it is mostly background.
        cover: 0 to 1, 1 less the share of the background.
    """

    rgb: U8
    range: F32
    cover: F32


class SplatRenderer:
    """Renders a layer of splats."""

    def __init__(self, layer: SplatLayer) -> None:
        self._parameters, self._background = layer.splats.parameters, Background(layer.background)

    def view(self, camera: Camera, T_world_cam: F64) -> SplatImage:
        """Render the view of a camera with the pose `T_world_cam` (4, 4)."""
        if camera.model == "pinhole":
            colour, distance, cover = self._pinhole(camera, T_world_cam)
        else:
            colour, distance, cover = self._resampled(camera, T_world_cam)
        levels = np.clip(np.rint(colour * 255), 0, 255).astype(np.uint8)
        return SplatImage(levels, np.where(cover > SOLID, distance, np.float32(np.inf)), cover)

    def _pinhole(self, camera: Camera, T_world_cam: F64) -> tuple[F32, F32, F32]:
        """Colour, range and cover of a pinhole view."""
        x, y = np.meshgrid((np.arange(camera.width) - camera.cx) / camera.fx,
                           (np.arange(camera.height) - camera.cy) / camera.fy)  # fmt: skip
        rays = np.stack([x, y, np.ones_like(x)], axis=-1)
        drawn = rasterizer.render(self._parameters, Pinhole.of(camera, T_world_cam))
        colour = drawn.over(self._background.seen(texels(rays @ T_world_cam[:3, :3].T)))
        cover = 1 - drawn.transmittance
        depth = drawn.depth / np.maximum(cover, 1e-6)
        return colour, (depth * np.linalg.norm(rays, axis=-1)).astype(np.float32), cover

    def _resampled(self, camera: Camera, T_world_cam: F64) -> tuple[F32, F32, F32]:
        """The same of other cameras: each pixel from the face of a cube that its ray passes."""
        import cv2

        from scan2sim.pipeline.camera.models import pixel_angle, pixel_rays

        rays = pixel_rays(camera).astype(np.float64)
        seen = np.isfinite(rays).all(axis=-1)
        rays = np.nan_to_num(rays)
        side = max(16, round(2 * FACE_DENSITY / pixel_angle(camera)))
        face = Camera("pinhole", side, side, side / 2, side / 2, (side - 1) / 2, (side - 1) / 2)
        found = np.zeros((*rays.shape[:2], 5), np.float32)
        for rotation in FACE_ROTATIONS:
            own = rays @ rotation
            through = seen & (own[..., 2] >= np.abs(own[..., :2]).max(axis=-1)) & (own[..., 2] > 0)
            if not through.any():
                continue
            pose = np.asarray(T_world_cam, np.float64).copy()
            pose[:3, :3] = pose[:3, :3] @ rotation
            colour, distance, cover = self._pinhole(face, pose)
            image = np.dstack([colour, distance, cover])
            x, y = (own[..., k] / np.maximum(own[..., 2], 1e-9) * face.fx + face.cx for k in (0, 1))
            sampled = cv2.remap(
                image, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            )
            found[through] = sampled[through]
        return found[..., :3], found[..., 3], found[..., 4]
