"""Fast renderer of equirectangular images of a town: ray casting by Open3D, colours by a compiled shader.

Textures are procedural and band-limited: details finer than a pixel's footprint fade out (`materials`). The ground is
not a mesh: two planes and a raster of distances (`ground`) define road, kerb and pavement.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.data_samples import rays as tracing
from scan2sim.data_samples import shader, signs, sky
from scan2sim.data_samples.ground import CELL_M, KERB_HEIGHT_M
from scan2sim.data_samples.hills import heights, relative_waves
from scan2sim.data_samples.scene import caster, srgb, tensor
from scan2sim.data_samples.shapes import Part
from scan2sim.data_samples.town import Town
from scan2sim.data_samples.traffic import Traffic
from scan2sim.pipeline.core.types import F32, F64, U8

MESH_RADIUS_M = 220.0  # around the camera, within which meshes are loaded
REBUILD_SHARE = 0.25  # share of the radius driven before the meshes are rebuilt
OWN_CAR_ELEVATION_DEG = -60.0  # elevation below which the camera sees its own car
GAIN_RANGE = (0.6, 1.4)  # bounds of the exposure
SUPERSAMPLING_CONTRAST = 20  # difference of neighbouring pixels, in 8-bit levels, above which more rays are cast
LENS_BLUR_PX = 0.55  # standard deviation
GLARE = ((40.0, 0.8), (1.5, 5.0), (0.25, 30.0))
"""Glare of a low sun as (linear light, angle in degrees at which it falls to 1/e): the disc, a glow, a veil."""
SRGB_TABLE = srgb(np.linspace(0, 1, 8192) ** 2)
"""sRGB values by the square root of linear light."""

Index = npt.NDArray[Any]


@dataclass(frozen=True)
class PanoramaImage:
    """A rendered panorama.

    Attributes:
        rgb: (H, W, 3).
        depth: (H, W) metres along the ray (infinite: sky, NaN: own car).
        moving: (H, W) whether the pixel shows another vehicle.
        gain: exposure, factor on the light.
    """

    rgb: U8
    depth: F32
    moving: Index
    gain: float


class Panorama:
    """A 360-degree camera in a town.

    Args:
        town: static surroundings.
        traffic: other vehicles; None: none.
        height: rows of an image; it has twice as many columns.
        seed: seed of the exposure changes.
        samples: rays per pixel where neighbours differ; 1 is fastest.
        lens: distance of the front lens, and of the back lens, from the camera's centre, metres.
        radius: distance from the camera within which objects are rendered, metres.
    """

    def __init__(
        self,
        town: Town,
        traffic: Traffic | None,
        height: int = 1024,
        seed: int = 0,
        samples: int = 3,
        lens: float = 0.0,
        radius: float = MESH_RADIUS_M,
    ) -> None:
        self.samples, self.lens, self.radius = samples, lens, radius
        self.town, self.traffic, self.height, self.width = town, traffic, height, 2 * height
        self._centre = np.full(2, np.inf)
        self._static: tuple[Any, ...] = ()
        self._caster: Any = None
        self._sign_images = signs.images()
        self._sky = _sky(town)
        self.mask, self._own = own_car(height), _roof(height)
        self._visible_rows = int(np.flatnonzero(self.mask.any(axis=1))[-1]) + 1  # rows not covered by the own car
        rng = np.random.default_rng([seed, 41])
        self._waves = rng.uniform(0.015, 0.22, 9), rng.uniform(0, 2 * np.pi, 9)

    def gain(self, time: float) -> float:
        """Exposure at a time, a factor on the light: smooth, between the bounds of `GAIN_RANGE`."""
        frequency, phase = self._waves
        x = np.sin(2 * np.pi * frequency * time + phase).sum() / np.sqrt(len(phase) / 2)
        low, high = GAIN_RANGE
        return float(low * (high / low) ** (0.5 + 0.5 * np.tanh(0.9 * x)))

    def render(self, poses: F64, time: float = 0.0) -> PanoramaImage:
        """Render an image.

        Args:
            poses: (4, 4) camera to world, or (H, 4, 4) one per row (rolling shutter).
            time: seconds, for traffic (which doesn't move during the readout) and exposure.
        """
        h, w, visible = self.height, self.width, self._visible_rows
        rows = np.broadcast_to(poses, (h, 4, 4))[:visible]
        self._update_meshes(rows[len(rows) // 2, :2, 3])
        trace = self._tracer(rows, time)
        rgb, distance, moved = trace(np.arange(visible * w), 0.0, 0.0)
        if self.samples > 1:
            at = np.flatnonzero(tracing.high_contrast(rgb.reshape(visible, w, 3), SUPERSAMPLING_CONTRAST))
            total = rgb[at].astype(np.uint16)
            for right, down in subpixel_offsets(self.samples - 1):
                total += trace(at, right, down)[0]
            rgb[at] = (total + self.samples // 2) // self.samples
        image, depth, moving = (
            np.zeros((h, w, 3), np.uint8),
            np.full((h, w), np.nan, np.float32),
            np.zeros((h, w), bool),
        )
        parts = (a.reshape(visible, w, *a.shape[1:]) for a in (rgb, distance, moved))
        image[:visible], depth[:visible], moving[:visible] = parts
        image = _lens_blur(image)
        if self.town.low_sun:
            image = self._with_glare(image, rows[len(rows) // 2], time)
        low = slice(int(np.flatnonzero((self.mask == 0).any(axis=1))[0]), None)
        own = self.mask[low] == 0
        image[low][own], depth[low][own], moving[low][own] = self._own[low][own], np.nan, False
        return PanoramaImage(image, depth, moving, self.gain(time))

    def _tracer(self, rows: F64, time: float) -> Callable[[Index, float, float], tuple[U8, F32, Index]]:
        """Function that renders pixels (N,) at a subpixel offset: rgb (N, 3), distance (N,), vehicle or not (N,)."""
        origins = (rows[:, :3, 3] - [*self._centre, 0]).astype(np.float32)
        turns = np.ascontiguousarray(rows[:, :3, :3], np.float32)
        moving, boxes = self.traffic.near(time, self._centre) if self.traffic else (None, np.zeros((0, 6), np.float32))
        moving = None if moving is None else self.town.lifted(moving, self._centre)
        nearby = None if moving is None else caster(moving)
        other = self._static if moving is None else _arrays(moving)
        g = self.town.ground
        hills = relative_waves(g.hills, self._centre)
        up = heights(boxes[:, :2], hills)
        near_vehicle = _pixels_of_vehicles(boxes, up, rows, self._centre, self.width, self.height)
        lines = g.line[:, :2] - self._centre
        ground = (g.distance, g.nearest, g.line, g.origin - self._centre, CELL_M, KERB_HEIGHT_M, lines, hills)
        sun, gain = self.town.sun.astype(np.float32), self.gain(time)

        def trace(index: Index, right: float, down: float) -> tuple[U8, F32, Index]:
            rays = tracing.rays(turns, origins, self.width, self.height, index, right, down, self.lens)
            distance, face, uv = _cast(self._caster, rays)
            moved = np.zeros(len(rays), bool)
            if nearby is not None:
                at = np.flatnonzero(near_vehicle[index])
                near, near_face, near_uv = _cast(nearby, rays[at])
                closer = near < distance[at]
                at = at[closer]
                distance[at], face[at], uv[at], moved[at] = near[closer], near_face[closer], near_uv[closer], True
            kind, normal, shadow = tracing.hit_ground(rays, distance, face, uv, moved, self._static, other, ground, sun)
            dark = self._caster.test_occlusions(tensor(shadow)).numpy()
            rgb = shader.shade(
                rays, distance, face, uv, moved, kind, normal, dark, self._static, other, ground, boxes, sun, self._sky,
                self._centre, self._sign_images, np.pi / self.height, gain, SRGB_TABLE, self.town.seed % 1000,
            )  # fmt: skip
            return rgb, distance, moved

        return trace

    def _with_glare(self, image: U8, pose: F64, time: float) -> U8:
        """Image with the glare of the sun in the lens, in proportion to the visible share of the sun."""
        jitter = np.random.default_rng(0).normal(0, np.radians(0.6), (32, 3))
        ray = np.concatenate(
            [np.broadcast_to(pose[:3, 3] - [*self._centre, 0], jitter.shape), self.town.sun + jitter], 1
        )
        visible = 1 - self._caster.test_occlusions(tensor(ray.astype(np.float32))).numpy().mean()
        to = self.town.sun @ pose[:3, :3]
        lon = ((np.arange(self.width) + 0.5) / self.width - 0.5) * 2 * np.pi
        lat = ((np.arange(self.height) + 0.5) / self.height - 0.5) * np.pi
        level = to[0] * np.sin(lon) + to[2] * np.cos(lon)
        cosine = np.cos(lat)[:, None] * level + (np.sin(lat) * to[1])[:, None]
        angle = np.degrees(np.arccos(np.clip(cosine, -1, 1))).astype(np.float32)
        glow = sum(strength * np.exp(-angle / width) for strength, width in GLARE)
        glare = (visible * self.gain(time) * glow)[..., None] * np.array(shader.SUN_RGB, np.float32)
        return to_srgb(linear_light(image) + glare)

    def _update_meshes(self, centre: F64) -> None:
        """Rebuild the meshes around a position if the camera has moved far enough."""
        if np.linalg.norm(centre - self._centre) < REBUILD_SHARE * self.radius:
            return
        self._centre = np.round(centre)
        part = self.town.near(self._centre, self.radius)
        self._static, self._caster = _arrays(part), caster(part)


def linear_light(image: U8) -> F32:
    """Linear light of an 8-bit sRGB image."""
    x = np.arange(256, dtype=np.float32) / 255
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4).astype(np.float32)[image]


def to_srgb(light: F32) -> U8:
    """8-bit sRGB of linear light, clipped."""
    roots = np.sqrt(np.clip(light, 0, 1))
    return SRGB_TABLE[(roots * (len(SRGB_TABLE) - 1)).astype(np.int32)]


def subpixel_offsets(count: int) -> list[tuple[float, float]]:
    """Offsets (right, down) of additional rays around a pixel's centre, in pixels."""
    angle = 0.4 + 2 * np.pi * np.arange(count) / max(count, 1)
    return [(0.37 * float(np.cos(a)), 0.37 * float(np.sin(a))) for a in angle]


def _lens_blur(image: U8) -> U8:
    """Image blurred slightly as by a lens, wrapping around at the left and right edge."""
    import cv2

    wide = cv2.GaussianBlur(np.concatenate([image[:, -4:], image, image[:, :4]], axis=1), (5, 5), LENS_BLUR_PX)
    return np.ascontiguousarray(wide[:, 4:-4])


def own_car(height: int) -> U8:
    """(H, 2H) ego-vehicle mask: 0 where the camera sees its own car, 255 elsewhere."""
    lon = ((np.arange(2 * height) + 0.5) / height - 1) * np.pi
    lat = 90 - (np.arange(height) + 0.5) / height * 180
    edge = OWN_CAR_ELEVATION_DEG - 5 * np.sin(lon) ** 4 + 2 * np.cos(lon)  # the roof is longer than it is wide
    return np.where(lat[:, None] < edge, 0, 255).astype(np.uint8)


def _roof(height: int) -> U8:
    """(H, 2H, 3) image of the own car's roof: grey, slightly lighter ahead, with two rails."""
    lon = ((np.arange(2 * height) + 0.5) / height - 1) * np.pi
    lat = ((np.arange(height) + 0.5) / height - 0.5) * np.pi
    r = 1 / np.tan(np.maximum(lat, 0.1))[:, None]
    x, z = r * np.sin(lon), r * np.cos(lon)
    grey = 46 + 14 * np.tanh(z) + 60 * np.exp(-(((np.abs(x) - 0.33) / 0.03) ** 2))
    return np.repeat(np.clip(grey, 0, 255)[..., None], 3, axis=2).astype(np.uint8)


def _sky(town: Town, height: int = 1024) -> F32:
    """Sky image (height / 2, 2 height, 3), linear light of the upper hemisphere: row 0 is the zenith, column 0 -x."""
    lon = ((np.arange(2 * height) + 0.5) / height - 1) * np.pi
    lat = np.pi / 2 * (1 - (np.arange(height // 2) + 0.5) / (height // 2))
    c = np.cos(lat)[:, None]
    d = np.stack([c * np.cos(lon), c * np.sin(lon), np.broadcast_to(np.sin(lat)[:, None], (len(lat), len(lon)))], -1)
    d = d.reshape(-1, 3).astype(np.float32)
    light = sky.beyond(
        np.zeros_like(d), d, town.sun, 0.45, np.array([0.0, 1e-3, 4.0]), np.zeros(2), town.seed % 1000 + 7
    )
    return light.reshape(height // 2, 2 * height, 3)


def _pixels_of_vehicles(boxes: F32, up: F64, rows: F64, centre: F64, width: int, height: int) -> Index:
    """(R * W,) bool: pixels that may show one of the vehicles.

    Args:
        boxes: (K, 6) vehicles, as of `Traffic.near`.
        up: (K,) height of the ground below them.
        rows: (R, 4, 4) camera pose of each row.
        centre: (2,) origin of the boxes' coordinates.
        width, height: size of the image.
    """
    covered = np.zeros((len(rows), width), bool)
    pose = rows[len(rows) // 2]
    for (x, y, _, _, long, wide), z in zip(boxes.tolist(), up.tolist(), strict=True):
        radius = np.hypot(long, wide) + 0.3
        to = (np.array([*(np.array([x, y]) + centre), 1.5 + z]) - pose[:3, 3]) @ pose[:3, :3]
        distance = np.hypot(to[0], to[2])
        if distance < radius + 0.5:
            covered[:] = True
            continue
        lon, half = np.arctan2(to[0], to[2]), np.arcsin(min(radius / distance, 1.0)) + 0.02
        top, low = (np.arctan2(z, distance - radius) + 0.06 for z in (to[1] - 3.2, to[1] + 2.0))
        columns = np.arange(
            int((lon - half + np.pi) / (2 * np.pi) * width), int((lon + half + np.pi) / (2 * np.pi) * width) + 2
        )
        row = [int((a / np.pi + 0.5) * height) for a in (top - 0.12, low)]
        covered[max(row[0], 0) : row[1] + 2, columns % width] = True
    return covered.ravel()


def _arrays(part: Part) -> tuple[Any, ...]:
    """Arrays of a mesh in the order in which the shader expects them."""
    return (part.faces, part.normals, part.uv, part.sky[:, None], part.material, part.colour, part.seed, part.size)


def _cast(scene: Any, rays: F32) -> tuple[F32, Any, F32]:
    """Distance (N,), face (N,) uint32 and barycentric uv (N, 2) of the first hits of rays (N, 6)."""
    answer = scene.cast_rays(tensor(rays))
    return answer["t_hit"].numpy(), answer["primitive_ids"].numpy(), answer["primitive_uvs"].numpy()
