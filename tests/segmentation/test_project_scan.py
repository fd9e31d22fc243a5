"""Projection of a scan into photos: positions, heights, slopes and occlusion."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.core.types import F64, Camera, Frame, PointCloud, View
from scan2sim.segmentation.lidar_channels import encode, encode_height, ground_level
from scan2sim.segmentation.project_scan import ScanProjector, filled

PINHOLE = Camera("pinhole", 640, 480, 500.0, 500.0, 319.5, 239.5)
PANORAMA = Camera("equirectangular", 1024, 512)


def view(camera: Camera) -> View:
    """View from 2 m above the origin along x."""
    pose: F64 = np.eye(4)
    pose[:3, :3] = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    pose[2, 3] = 2.0
    return View("a", camera, pose, Path("a.jpg"))


def grid(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    return np.stack(np.meshgrid(x, y, z), axis=-1).reshape(-1, 3).astype(np.float32)


@pytest.fixture(scope="module")
def scan() -> ScanProjector:
    """A 16 m wide road with a pavement 12 cm higher on the left, and a wall 3 m high across it 10 m ahead."""
    step = np.arange(-8, 25, 0.1)
    ground = grid(step, np.arange(-8, 8, 0.1), np.zeros(1))
    ground[ground[:, 1] > 3, 2] = 0.12
    wall = grid(np.full(1, 10.0), np.arange(-2, 2, 0.1), np.arange(0.1, 3, 0.1))
    return ScanProjector(PointCloud(Frame(), np.concatenate([ground, wall])), 0.1)


def code(channels: np.ndarray, camera: Camera, x: float, y: float, z: float) -> np.ndarray:
    """The channels at a point in the world."""
    h, w = channels.shape[:2]
    if camera is PANORAMA:
        u, v = 0.5 - np.arctan2(y, x) / (2 * np.pi), 0.5 + np.arctan2(2 - z, np.hypot(x, y)) / np.pi
    else:
        u, v = 0.5 - y / x * 500 / 640, 0.5 + (2 - z) / x * 500 / 480
    return channels[int(v * h), int(u * w)].astype(float)


@pytest.mark.parametrize("camera", [PINHOLE, PANORAMA], ids=["pinhole", "panorama"])
def test_channels_have_correct_heights_distances_and_slopes(scan: ScanProjector, camera: Camera) -> None:
    channels = scan.channels(view(camera), (camera.width, camera.height))
    assert channels.shape == (camera.height // 4, camera.width // 4, 4)
    wall, road, behind = code(channels, camera, 10, 0.5, 1.5), code(channels, camera, 6, 0.5, 0), channels[0, 0]
    assert wall[0] == pytest.approx(encode_height(np.array([1.5], np.float32)), abs=4) and wall[2] < 30
    assert road[0] == pytest.approx(128, abs=6) and road[2] > 225
    assert wall[1] > road[1] and wall[3] == road[3] == 255
    assert (behind == 0).all(), "there are no points in the sky"
    kerb = code(channels, camera, 8, 3.6, 0.12)[0] - code(channels, camera, 8, 2.4, 0)[0]
    assert kerb > 12, "kerbs are visible in the height channel"


def test_nearest_point_occludes_others(scan: ScanProjector) -> None:
    nearest, distance = scan.nearest(view(PINHOLE), (640, 480))
    middle = distance[distance.shape[0] // 2, distance.shape[1] // 2]
    assert middle == pytest.approx(10, abs=0.2)
    assert (nearest[np.isinf(distance)] == -1).all() and (nearest[np.isfinite(distance)] >= 0).all()


def test_small_gaps_are_filled_and_large_ones_kept() -> None:
    far = np.full((9, 9), 10, np.float32)
    far[2, 2] = far[5:8, 5:8] = np.inf
    closed = filled(encode(np.zeros_like(far), far, np.ones_like(far)))
    assert closed[2, 2, 3] == 255 and closed[6, 6, 3] == 0


def test_ground_level_follows_slopes_but_not_kerbs() -> None:
    xyz = grid(np.arange(0, 60, 0.25), np.arange(-5, 5, 0.25), np.zeros(1))
    xyz[:, 2] = 0.08 * xyz[:, 0] + 0.12 * (xyz[:, 1] > 0)
    above = ground_level(xyz).above(xyz)
    inner = (np.abs(xyz[:, 0] - 30) < 20) & (np.abs(np.abs(xyz[:, 1]) - 0.6) < 0.3)
    left, right = (above[inner & side].mean() for side in (xyz[:, 1] > 0, xyz[:, 1] < 0))
    assert left - right > 0.08 and abs(left + right) < 0.04
