"""Random synthetic scene that covers all cases of the blending kernels: occlusion, masks, warps, overexposure."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from scan2sim.pipeline.camera.models import pixel_angle, unproject
from scan2sim.pipeline.camera.projection import posed_camera
from scan2sim.pipeline.core.types import F32, Camera
from scan2sim.texturing import texel_map
from scan2sim.texturing.bake import blend_numba
from scan2sim.texturing.photo_cache import downsampled, low_frequencies

CAMERAS = {
    "pinhole": Camera("pinhole", 97, 71, 60.0, 62.0, 47.0, 36.0),
    "opencv": Camera("opencv", 97, 71, 60.0, 62.0, 47.0, 36.0, (-0.2, 0.05, 0.001, -0.002)),
    "fisheye": Camera("fisheye", 97, 71, 40.0, 41.0, 47.0, 36.0, (0.02, -0.003, 0.0, 0.0)),
    "equirectangular": Camera("equirectangular", 142, 71),
    "orthographic": Camera("orthographic", 97, 71, 12.0, 12.0, 47.0, 36.0),
}
CELL, CELLS = 12, 8
"""Texels per side of a square on the page, and squares per side of the page."""


def random_squares(rng: np.random.Generator, camera: Camera) -> blend_numba.PageFaces:
    """Squares of random size and orientation around a camera at the origin; each has its own cell on the page."""
    n = CELLS**2
    u, v = rng.uniform(-0.2, 1.2, n) * camera.width, rng.uniform(-0.1, 1.1, n) * camera.height
    away = rng.uniform(2, 12, n)[:, None]
    if camera.model == "orthographic":
        middle = np.column_stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, away])
    else:
        ray = unproject(camera, np.column_stack([u, v]))
        middle = np.where(np.isfinite(ray), ray, [1.0, 0.0, 0.0]) * away
    facing = -middle / np.linalg.norm(middle, axis=1, keepdims=True) + rng.normal(0, 0.6, (n, 3))
    facing /= np.linalg.norm(facing, axis=1, keepdims=True)
    right = np.cross(facing, [0.1, 0.9, 0.3])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    span = (rng.uniform(0.02, 0.6, n) * (6 if camera.model == "orthographic" else away[:, 0]))[:, None]
    across, down = right * span, np.cross(right, facing) * span * rng.uniform(0.5, 2, (n, 1))
    corners = np.stack([middle - across - down, middle + across - down, middle + across + down, middle - across + down])
    low = np.stack(np.divmod(np.arange(n), CELLS), axis=1)[:, None] * CELL - 0.3
    flat = low + np.array([[0.0, 0.0], [CELL, 0.0], [CELL, CELL], [0.0, CELL]]) * 0.93
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    on_page: F32 = flat[:, triangles].reshape(-1, 3, 2).astype(np.float32)
    in_space: F32 = corners.transpose(1, 0, 2)[:, triangles].reshape(-1, 3, 3).astype(np.float32)
    owner = texel_map.owners(on_page, CELL * CELLS, CELL * CELLS)
    return blend_numba.PageFaces(owner, on_page, in_space, np.repeat(facing, 2, axis=0).astype(np.float32))


def random_photo(rng: np.random.Generator, camera: Camera, band: int) -> blend_numba.BlendSource:
    """A random photo with occluders, a mask, a warp, an exposure and overexposed patches."""

    def patches(values: Any, size: int) -> Any:
        return np.kron(rng.choice(values, (12, 24)), np.ones((size, size))).astype(np.float32)

    whole = rng.integers(0, 256, (camera.height, camera.width, 3)).astype(np.uint8)
    whole = cv2.GaussianBlur(whole, (0, 0), 0.8)
    whole[10:20, 15:40] = 255
    half = downsampled(whole, 2)
    first = patches([np.inf, 9.0, 6.0, 4.0], 8)
    wider = camera.resized(first.shape[1], first.shape[0])
    photo = blend_numba.PhotoData(
        whole, half, downsampled(half, 2), low_frequencies(whole, max(1, band)),
        rng.choice([0, 255, 255, 255], (24, 33)).astype(np.uint8), rng.normal(0, 2, (5, 7, 2)).astype(np.float32),
        np.array([0.1, -0.05, 0.02, 0.3, 0.2]),
    )  # fmt: skip
    near, around = (np.asarray(cv2.erode(first, np.ones((n, n)))) for n in (3, 7))
    return blend_numba.BlendSource(
        photo, posed_camera(camera, np.eye(4)), blend_numba.Occlusion(first, pixel_angle(wider), near, around, 3)
    )
