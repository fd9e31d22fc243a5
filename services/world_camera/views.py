"""Views of the world through a moving camera: rolling shutter, exposure, and a simulator's images in front."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Protocol

import numpy as np

from scan2sim.pipeline.core.classes import UNCLASSIFIED
from scan2sim.pipeline.core.poses import interpolate
from scan2sim.pipeline.core.types import F32, F64, I32, U8, Camera
from scan2sim.pipeline.io.worlds.instances import Instance

MAX_BANDS, BAND_PX = 16, 1.0
"""Bands of rows that an image with rolling shutter is rendered in, and the motion in pixels from band to band."""
NEAR_M = 5.0
"""Distance of the surfaces by whose apparent motion the number of bands is chosen."""


class CameraImage(Protocol):
    """What a camera sees of the world (`texturing.world_camera.CameraImage`)."""

    @property
    def rgb(self) -> U8:
        """(H, W, 3) colours."""

    @property
    def code(self) -> U8:
        """(H, W) LAS codes."""

    @property
    def instance(self) -> I32:
        """(H, W) ids of instances."""

    def depth(self, camera: Camera) -> F32:
        """(H, W) metres along the optical axis."""


class World(Protocol):
    """A world to render (`texturing.world_camera.WorldCamera`)."""

    @property
    def instances(self) -> Mapping[int, Instance]:
        """Instances of what has been rendered so far, by id."""

    def render(self, T_world_cam: F64, camera: Camera) -> CameraImage:
        """Render the view of a camera with a pose (4, 4), optical axes."""


@dataclass(frozen=True)
class View:
    """What the camera sees; arrays are (H, W).

    Attributes:
        rgb: (H, W, 3) uint8.
        depth: metres along the optical axis, inf where there is nothing, NaN where the lens sees nothing, or more than
            90 degrees from the axis.
        code: uint8 LAS codes, 0 where there is no surface, 1 (unclassified) on what a simulator shows.
        instance: int32 ids of instances, 0 where there is none, and on what a simulator shows.
    """

    rgb: U8
    depth: F32
    code: U8
    instance: I32


def rendered(world: World, camera: Camera, poses: F64) -> View:
    """Render a view.

    Args:
        world: what is seen.
        camera: its intrinsics.
        poses: (K, 4, 4) poses, optical axes; of a rolling shutter, evenly from the first row's to the last row's.
    """
    edges = np.linspace(0, camera.height, _band_count(camera, poses) + 1).round().astype(int).tolist()
    times = np.linspace(0, 1, len(poses))
    parts = []
    for first, end in pairwise(edges):
        band = replace(camera, height=end - first, cy=camera.cy - first)
        share = (first + end - 1) / 2 / max(1, camera.height - 1)
        image = world.render(interpolate(poses, times, np.array([share]))[0], band)
        depth = image.depth(band)
        parts.append(View(image.rgb, np.where(depth < 0, np.float32(np.nan), depth), image.code, image.instance))
    return View(
        np.concatenate([part.rgb for part in parts]),
        np.concatenate([part.depth for part in parts]),
        np.concatenate([part.code for part in parts]),
        np.concatenate([part.instance for part in parts]),
    )


def _band_count(camera: Camera, poses: F64) -> int:
    """Number of bands of rows, from each of which to the next the image moves by about `BAND_PX`."""
    first, last = poses[0], poses[-1]
    cosine = (np.trace(first[:3, :3].T @ last[:3, :3]) - 1) / 2
    turn = np.arccos(np.clip(cosine, -1, 1)) + np.linalg.norm(last[:3, 3] - first[:3, 3]) / NEAR_M
    return int(np.clip(np.ceil(turn * max(camera.fx, camera.fy) / BAND_PX), 1, min(MAX_BANDS, camera.height)))


def composed(view: View, rgb: U8, depth: F32, tolerance: float) -> View:
    """Lay a simulator's image over a view where it is nearer.

    Args:
        view: the world.
        rgb: (H, W, 3) what the simulator shows.
        depth: (H, W) its metres along the optical axis; NaN, inf or 0: nothing, -inf: too close to measure.
        tolerance: metres by which it must be nearer than the world beside it: the simulator may show the world, too.
    """
    import cv2

    far = np.where(np.isnan(view.depth), np.float32(np.inf), view.depth)
    world = cv2.erode(far, np.ones((3, 3), np.uint8))  # the nearest of its neighbours: edges differ by a pixel
    own = np.where(np.isnan(depth) | (depth == 0), np.float32(np.inf), depth)
    front = own < world - np.float32(tolerance)
    return View(
        np.where(front[..., None], rgb, view.rgb),
        np.where(front, own, view.depth).astype(np.float32),
        np.where(front, np.uint8(UNCLASSIFIED), view.code),
        np.where(front, np.int32(0), view.instance),
    )


def exposed(rgb: U8, stops: float) -> U8:
    """Change the exposure of an image (H, W, 3), sRGB, by stops (EV): 1 doubles the light."""
    if stops == 0:
        return rgb
    level = np.arange(256) / 255
    linear = np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4) * 2.0**stops
    light = np.clip(linear, 0, 1)
    srgb = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    table = np.rint(255 * srgb).astype(np.uint8)
    return np.asarray(table[rgb], np.uint8)
