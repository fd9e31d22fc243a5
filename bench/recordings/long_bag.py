"""Memory of `scan2sim import bag` over the length of a recording: a scanner of 64 lines with a camera."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.maps.command import scan2sim
from scan2sim.pipeline.core.types import Camera
from tests.fakes.bags import bag_file, records

RATE_HZ, SPEED_M_S = 10.0, 8.0


class Recording(NamedTuple):
    """A recording: number of sweeps, lines and columns of the scanner, and whether a camera records."""

    sweeps: int
    lines: int
    columns: int
    camera: bool


RECORDINGS = (Recording(150, 64, 940, True), Recording(36_000, 8, 375, False), Recording(400, 64, 940, True))
"""A short one, an hour, and a long one with images, whose time is reported."""
CAMERA = Camera("pinhole", 640, 480, 400.0, 400.0, 319.5, 239.5)
AXES = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""T_lidar_camera."""


def measure(out: Path) -> dict[str, Any]:
    """`long_bag_peak_gb` and `long_bag_seconds` of the longest recording, and the ratio of peaks to the shortest."""
    shutil.rmtree(out, ignore_errors=True)
    peaks, seconds = [], 0.0
    for one in RECORDINGS:
        bag = write(out / f"bag_{one.sweeps}", one)
        measured = scan2sim(out / f"{one.sweeps}.log", "import", "bag", bag, "--out", out / f"tile_{one.sweeps}")
        peaks.append(measured.peak_gb)
        seconds = measured.seconds
        points = one.sweeps * one.lines * one.columns / 1e6
        size = sum(file.stat().st_size for file in bag.iterdir()) / 1e9
        what = f"{one.sweeps / RATE_HZ / 60:.1f} min, {points:.0f} M points, {size:.2f} GB"
        print(f"long_bag {what}: {measured.peak_gb:.2f} GB, {seconds:.0f} s", flush=True)
        shutil.rmtree(bag)
        shutil.rmtree(out / f"tile_{one.sweeps}")
    return {
        "long_bag_peak_gb": round(max(peaks), 2), "long_bag_seconds": round(seconds),
        "long_bag_peak_ratio": round(peaks[-1] / peaks[0], 2), "long_bag_hour_gb": round(peaks[1], 2),
    }  # fmt: skip


def write(path: Path, recording: Recording) -> Path:
    """Write a bag of random returns around a straight path, with a raw image for each sweep if there is a camera."""
    rng = np.random.default_rng(0)
    path.parent.mkdir(parents=True, exist_ok=True)
    columns = np.linspace(np.pi, -np.pi, recording.columns, endpoint=False)
    lines = np.radians(np.linspace(-25, 15, recording.lines))
    azimuth, elevation = (angle.ravel() for angle in np.meshgrid(columns, lines))
    rays = np.stack(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], axis=1
    )
    offsets = ((np.pi - azimuth) / (2 * np.pi) / RATE_HZ).astype(np.float32)
    image = rng.integers(0, 255, (CAMERA.height, CAMERA.width, 3), np.uint8)
    start, T = 1_700_000_000.0, np.eye(4)
    with bag_file(path, "mcap") as bag:
        links = [("base", "lidar", np.eye(4), start), ("lidar", "camera", AXES, start)]
        bag.transforms("/tf_static", start, links)
        for k in range(recording.sweeps):
            time = start + k / RATE_HZ
            T[0, 3] = SPEED_M_S * k / RATE_HZ
            xyz = rays * (10 + 25 * rng.random(len(rays)))[:, None]
            bag.transforms("/tf", time, [("map", "base", T, time)])
            bag.cloud("/points", time, "lidar", records(xyz, intensity=np.full(len(xyz), 99, np.uint8), time=offsets))
            if recording.camera:
                bag.image("/camera/image_raw", time, "camera", image, "rgb8")
                bag.camera_info("/camera/camera_info", time, "camera", CAMERA)
    return path
