"""Cameras of the recording vehicle, and their ray-cast photos with exact poses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scan2sim.data_samples.layout import Layout
from scan2sim.data_samples.scanner import Drive
from scan2sim.data_samples.scene import Scene, srgb
from scan2sim.pipeline.core.types import F32, F64, U8, Bools, Camera

CAMERA_ORDER = ("front", "pano", "left", "right")
STATION_SPACING_M = 5.0  # greatest distance between stations (if there are enough photos)
SUPERSAMPLING_CONTRAST = 0.1  # difference of neighbouring pixels (sRGB, 0 to 1) above which more rays are cast
SUBPIXEL_OFFSETS = ((-0.3, -0.1), (0.1, -0.3), (0.3, 0.1), (-0.1, 0.3))  # their positions around a pixel's centre


@dataclass(frozen=True)
class Effects:
    """Effects of a camera.

    Attributes:
        exposure_ev: exposures are random in [-exposure_ev, exposure_ev], EV.
        noise: standard deviation of the sensor noise, as a share of full scale (sRGB).
        vignetting: share of light lost in the corners.
        quality: JPEG quality.
    """

    exposure_ev: float = 0.3
    noise: float = 0.005
    vignetting: float = 0.0
    quality: int = 92


@dataclass(frozen=True)
class Shot:
    """A planned photo: its name, the camera's name, pose (camera to local), GPS time, exposure in EV."""

    name: str
    camera: str
    T_world_cam: F64
    time: float
    ev: float


@dataclass(frozen=True)
class Rendering:
    """Rendered image: linear light (H, W, 3) float32, LAS codes (H, W), 0 for the sky, distance (H, W) metres."""

    light: F32
    classification: U8
    distance: F32


def cameras(width: int) -> dict[str, Camera]:
    """The vehicle's cameras, for pinhole photos `width` pixels wide (4:3) and a panorama 1.28 times as wide."""
    w, h = width, round(width * 0.75)
    centre = ((w - 1) / 2, (h - 1) / 2)
    f = 0.62 * w
    wide = 2 * round(0.64 * width)
    return {
        "front": Camera(
            "opencv", w, h, f, f, centre[0] + 0.004 * w, centre[1] - 0.003 * w, (-0.12, 0.03, 0.0006, -0.0004)
        ),
        "pano": Camera("equirectangular", wide, wide // 2),
        "left": Camera("pinhole", w, h, 0.55 * w, 0.55 * w, *centre),
        "right": Camera("pinhole", w, h, 0.55 * w, 0.55 * w, *centre),
    }


# position on the vehicle (forwards, left, up from the ground below the scanner), yaw to the left, pitch upwards
MOUNTS = {
    "front": ((0.9, 0.0, 2.15), 0.0, -2.0),
    "pano": ((0.0, 0.0, 2.75), 0.0, 0.0),
    "left": ((0.4, 0.45, 2.25), 58.0, 4.0),
    "right": ((0.4, -0.45, 2.25), -58.0, 4.0),
}


def plan_shots(layout: Layout, drive: Drive, photos: int, exposure_ev: float) -> list[Shot]:
    """Plan `photos` photos on the first pass, at stations at most 5 m apart, with the cameras in turn."""
    rng = np.random.default_rng([layout.seed, 3])
    length = layout.axis.length
    each = max(1, photos // int(np.ceil(length / STATION_SPACING_M)))
    stations = int(np.ceil(photos / each)) if photos else 0
    shots = []
    for i in range(photos):
        s = (i // each + 0.5) * length / stations
        camera = CAMERA_ORDER[i % 4]
        time = drive.time_at(s)
        pose = _pose(drive, float(time), camera, rng)
        shots.append(
            Shot(f"{i:04d}_{camera}", camera, pose, float(time), float(rng.uniform(-exposure_ev, exposure_ev)))
        )
    return shots


def _pose(drive: Drive, time: float, camera: str, rng: np.random.Generator) -> F64:
    """(4, 4) pose, camera to local coordinates, with small random rotations of the vehicle."""
    (ahead, left, up), yaw, pitch = MOUNTS[camera]
    ground, heading = drive.ground(np.array([time]))
    roll, sway, nod = rng.normal(0, np.radians(0.5), 3)
    a, p = heading[0] + np.radians(yaw) + sway, np.radians(pitch) + nod
    forward = np.array([np.cos(a) * np.cos(p), np.sin(a) * np.cos(p), np.sin(p)])
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    right, down = np.cos(roll) * right + np.sin(roll) * down, np.cos(roll) * down - np.sin(roll) * right
    c, s = np.cos(heading[0]), np.sin(heading[0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, down, forward], axis=1)
    pose[:3, 3] = ground[0] + [ahead * c - left * s, ahead * s + left * c, up]
    return pose


def directions(camera: Camera, pixels: npt.ArrayLike) -> F64:
    """(..., 3) unit directions of rays through pixels (..., 2), in camera axes."""
    p = np.asarray(pixels, np.float64)
    if camera.model == "equirectangular":
        lon = ((p[..., 0] + 0.5) / camera.width - 0.5) * 2 * np.pi
        lat = ((p[..., 1] + 0.5) / camera.height - 0.5) * np.pi
        return np.stack([np.cos(lat) * np.sin(lon), np.sin(lat), np.cos(lat) * np.cos(lon)], axis=-1)
    flat = (p - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    if camera.distortion:
        flat = _undistorted(flat, camera.distortion)
    d = np.concatenate([flat, np.ones((*flat.shape[:-1], 1))], axis=-1)
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def _undistorted(distorted: F64, coefficients: tuple[float, ...]) -> F64:
    """Undistorted points (..., 2) on the plane z = 1: inverts Brown-Conrady k1 k2 p1 p2 by fixed-point iteration."""
    k1, k2, p1, p2 = coefficients
    xy = distorted.copy()
    for _ in range(60):
        x, y = xy[..., 0], xy[..., 1]
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2 * r2
        tangential = np.stack([2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], axis=-1)
        new = (distorted - tangential) / radial[..., None]
        done = np.abs(new - xy).max() < 1e-9
        xy = new
        if done:
            break
    return xy


def render(scene: Scene, drive: Drive, camera: Camera, T_world_cam: F64, time: float | None) -> Rendering:
    """Render a photo: a ray through every pixel, and four more where neighbours differ.

    Args:
        scene: the street.
        drive: the vehicle's drive, which determines the moving car's pose.
        camera: the camera.
        T_world_cam: (4, 4) camera to local coordinates.
        time: GPS time; None: without the moving car.
    """
    h, w = camera.height, camera.width
    v, u = np.mgrid[:h, :w]
    pixels = np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float64)
    light = np.empty((h * w, 3), np.float32)
    classification, distance = np.empty(h * w, np.uint8), np.empty(h * w, np.float32)
    for part in _blocks(h * w):
        light[part], classification[part], distance[part] = _cast_pixels(
            scene, drive, camera, T_world_cam, time, pixels[part]
        )
    rough = np.flatnonzero(_edges(light.reshape(h, w, 3)))
    for part in _blocks(len(rough)):
        at = rough[part]
        light[at] = np.mean(
            [_cast_pixels(scene, drive, camera, T_world_cam, time, pixels[at] + d)[0] for d in SUBPIXEL_OFFSETS], axis=0
        )
    return Rendering(light.reshape(h, w, 3), classification.reshape(h, w), distance.reshape(h, w))


def _blocks(n: int, size: int = 1 << 20) -> Iterator[slice]:
    return (slice(i, min(i + size, n)) for i in range(0, n, size))


def _edges(light: F32) -> Bools:
    """(H * W,) whether a pixel differs by more than the contrast threshold from a neighbour."""
    gamma = np.clip(light, 0, 1) ** np.float32(1 / 2.2)
    edge = np.zeros(light.shape[:2], bool)
    across = np.abs(np.diff(gamma, axis=1)).max(axis=2) > SUPERSAMPLING_CONTRAST
    down = np.abs(np.diff(gamma, axis=0)).max(axis=2) > SUPERSAMPLING_CONTRAST
    edge[:, 1:] |= across
    edge[:, :-1] |= across
    edge[1:] |= down
    edge[:-1] |= down
    return edge.ravel()


def _cast_pixels(
    scene: Scene, drive: Drive, camera: Camera, T_world_cam: F64, time: float | None, pixels: F64
) -> tuple[F32, U8, F32]:
    """Linear light (N, 3), classification (N,) and distance (N,) through pixels (N, 2)."""
    from scan2sim.data_samples import sky

    rays = (directions(camera, pixels) @ T_world_cam[:3, :3].T).astype(np.float32)
    origins = np.broadcast_to(T_world_cam[:3, 3].astype(np.float32), rays.shape)
    car = None if time is None else drive.car(scene, np.array([time])).repeated(len(rays))
    hits = scene.cast(origins, rays, car)
    angle = 2 * np.pi / camera.width if camera.model == "equirectangular" else 1 / camera.fx
    light = scene.colour(origins, rays, hits, angle * np.where(hits.hit, hits.distance, 1), car)
    out = np.flatnonzero(~hits.hit)
    layout = scene.layout
    axis = np.array([layout.axis.heading, layout.axis.curvature, layout.lane])
    ends = layout.height(np.array([0.0, layout.axis.length]), 0.0)
    light[out] = sky.beyond(origins[out], rays[out], layout.sun, layout.cloudiness, axis, ends, layout.seed % 1000)
    classification = np.where(hits.hit, scene.surface.classification[hits.face], 0).astype(np.uint8)
    return light, classification, hits.distance


def develop(rendering: Rendering, ev: float, effects: Effects, rng: np.random.Generator) -> U8:
    """Photo (H, W, 3) in 8-bit sRGB: applies exposure and vignetting, then sensor noise."""
    light = rendering.light * np.float32(2.0**ev)
    if effects.vignetting:
        h, w = light.shape[:2]
        y, x = np.mgrid[-1 : 1 : h * 1j, -1 : 1 : w * 1j]
        light = light * (1 - effects.vignetting * (x * x + y * y) / 2)[..., None].astype(np.float32)
    image = srgb(light).astype(np.float32)
    image += rng.standard_normal(image.shape, np.float32) * np.float32(255 * effects.noise)
    return np.clip(image + 0.5, 0, 255).astype(np.uint8)
