"""Fixtures of the SLAM tests: a tiny 360-degree drive along a corridor with random textures, rendered once."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest

from scan2sim.pipeline.camera.models import pixel_rays
from scan2sim.pipeline.core.types import Camera, Trajectory
from scan2sim.pipeline.io.images.video import Encoder
from scan2sim.slam.geometry import exp_so3
from tests.present import present

HEIGHT, FPS, SECONDS, SPEED = 128, 10.0, 3.6, 6.0
WIDE, LOW, HIGH = 4.0, -2.0, 5.0  # metres: half a corridor's width, its floor and its ceiling
PERSPECTIVE = Camera("pinhole", 320, 160, 180.0, 180.0, 159.5, 79.5)
AHEAD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # camera to world: looks along +x, z up


@dataclass(frozen=True)
class Drive:
    """A folder with `video.mp4`, and ground truth."""

    folder: Path
    camera: Camera
    truth: Trajectory
    greys: np.ndarray  # (T, H, W)


def paint(seed: int) -> np.ndarray:
    """(1024, 1024) grey: blobs of 0.3 to 3 m on a wall of 64 x 64 m."""
    rng = np.random.default_rng(seed)
    out = np.zeros((1024, 1024), np.float32)
    for cells in (24, 64, 200):
        small = rng.standard_normal((cells, cells)).astype(np.float32)
        out += cv2.resize(small, (1024, 1024), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + 45 * out, 0, 255)


def film(camera: Camera, truth: Trajectory) -> np.ndarray:
    """Grey images (T, H, W) of the camera."""
    rays = pixel_rays(camera.scaled(2)).astype(np.float64)
    walls = [paint(k) for k in range(5)]
    frames = []
    for position, rotation in zip(truth.positions, present(truth.rotations), strict=True):
        d = rays @ rotation.T
        picture, nearest = np.zeros(d.shape[:2], np.float32), np.full(d.shape[:2], np.inf)
        sides = ((1, WIDE), (1, -WIDE), (2, LOW), (2, HIGH), (0, 60.0))
        for wall, (axis, at) in zip(walls, sides, strict=True):
            with np.errstate(divide="ignore"):
                far = (at - position[axis]) / d[..., axis]
            hit = (far > 0) & (far < nearest)
            across = [k for k in range(3) if k != axis]
            place = (position + np.where(hit, far, 0)[..., None] * d)[..., across] * 16 % 1024
            u, v = place.astype(np.float32).transpose(2, 0, 1)
            picture[hit] = cv2.remap(wall, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)[hit]
            nearest[hit] = far[hit]
        frames.append(cv2.resize(picture, (camera.width, camera.height), interpolation=cv2.INTER_AREA))
    return np.stack(frames).astype(np.uint8)


@pytest.fixture(scope="session")
def corridor(tmp_path_factory: pytest.TempPathFactory) -> Drive:
    """A drive of 20 m in a gentle bend."""
    camera = Camera("equirectangular", 2 * HEIGHT, HEIGHT)
    times = np.arange(0, SECONDS, 1 / FPS)
    heading = 0.15 * np.sin(times)
    steps = np.stack([np.cos(heading), np.sin(heading), 0 * heading], axis=1) * SPEED / FPS
    rotations = np.stack([exp_so3([0, 0, h]) @ AHEAD for h in heading])
    truth = Trajectory(times, np.cumsum(steps, axis=0) - steps[0], rotations)
    greys = film(camera, truth)
    folder = tmp_path_factory.mktemp("corridor")
    with Encoder(folder / "video.mp4", (camera.width, camera.height), FPS, preset="fast", crf="8") as encoder:
        for time, grey in zip(times, greys, strict=True):
            yuv = cv2.cvtColor(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), cv2.COLOR_BGR2YUV_I420)
            encoder.add(yuv, float(time))
    return Drive(folder, camera, truth, greys)


@pytest.fixture(scope="session")
def turn() -> tuple[Trajectory, np.ndarray]:
    """A path of 16 m that turns by 60 degrees, and images of a perspective camera along it."""
    heading = np.radians(60) * np.clip((np.arange(40) - 5) / 30, 0, 1)
    steps = 0.4 * np.stack([np.cos(heading), 0.15 * np.sin(heading), 0 * heading], axis=1)
    rotations = exp_so3(np.stack([0 * heading, 0 * heading, heading], axis=1)) @ AHEAD
    truth = Trajectory(np.arange(40) / 10, np.cumsum(steps, axis=0), rotations)
    return truth, film(PERSPECTIVE, truth)
