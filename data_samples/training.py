"""Labelled photos of many synthetic streets, no two alike, for a segmentation network to learn from.

`python -m scan2sim.data_samples.training OUT [--images 1200] [--seed 1000]`: OUT/images/*.jpg and OUT/labels/*.png (LAS
class codes a pixel, 0 sky, 255 not to be learnt). Streets, light, weather, camera and place are drawn anew, far
beyond what the streets of tests and benchmarks look like; seeds from 1000 on are kept for training, below for
everything else.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from scan2sim.data_samples.layout import RGB, Style, lay_out
from scan2sim.data_samples.photos import Effects, Rendering, develop, directions, render
from scan2sim.data_samples.scanner import Drive, plan_drive
from scan2sim.data_samples.scene import Scene
from scan2sim.pipeline.types import F64, U8, Camera

PER_STREET = 20
LENGTH = 60.0
HILLS = 0.11
"""Sine of the elevation above which what is beyond the street is surely sky."""
FIRST_SEED = 1000
"""Seeds from here on are of training streets."""


@dataclass(frozen=True)
class Weather:
    """What is between camera and street: share of fog's light, the distance it takes (metres), its colour."""

    reach: float
    colour: RGB


def any_style(rng: np.random.Generator) -> Style:
    """A street of any town, season and light."""

    def near(value: float) -> tuple[float, float]:
        return (value, value * 1.02 + 1e-6)

    def colours(n: int, low: float, high: float, tint: float) -> tuple[RGB, ...]:
        """Greys of linear light in [low, high], tinted."""
        grey = np.exp(rng.uniform(np.log(low), np.log(high), (n, 1)))
        rgb = np.clip(grey * np.exp(rng.normal(0, tint, (n, 3))), 0.005, 0.95)
        return tuple((float(r), float(g), float(b)) for r, g, b in rgb)

    def leaves(n: int) -> tuple[RGB, ...]:
        """Greens, from dark firs to yellow and brown autumn."""
        base = np.array([0.10, 0.20, 0.05]) * np.exp(rng.uniform(-1.0, 0.7, (n, 1)))
        base[:, 0] *= np.exp(rng.uniform(-0.4, 1.3, n) * (rng.random(n) < 0.7))
        rgb = np.clip(base * np.exp(rng.normal(0, 0.15, (n, 3))), 0.005, 0.9)
        return tuple((float(r), float(g), float(b)) for r, g, b in rgb)

    overcast = rng.random() < 0.4
    return Style(
        curve_radius=(120.0, 900.0),
        slope=(-0.05, 0.05),
        lane_width=near(rng.uniform(2.7, 4.2)),
        house_width=(rng.uniform(6, 9), rng.uniform(10, 22)),
        storeys=tuple(int(s) for s in rng.integers(1, 6, 5)),
        front_garden=(0.3, rng.uniform(2, 9)),
        gap_share=rng.uniform(0.1, 0.8),
        shop_share=rng.uniform(0, 0.6),
        brick_share=rng.uniform(0, 1),
        flat_roof_share=rng.uniform(0, 0.8),
        tree_spacing=(rng.uniform(4, 9), rng.uniform(10, 30)),
        tree_height=(rng.uniform(3.5, 6), rng.uniform(6, 12)),
        parked_spacing=(5.8, rng.uniform(8, 30)),
        moving_car=bool(rng.random() < 0.7),
        sun_elevation=near(rng.uniform(12, 75)),
        sun_strength=near(rng.uniform(0.02, 0.2) if overcast else rng.uniform(0.5, 1.1)),
        sky_strength=near(rng.uniform(0.5, 0.9) if overcast else rng.uniform(0.25, 0.55)),
        cloudiness=near(rng.uniform(0.7, 1.0) if overcast else rng.uniform(0.0, 0.7)),
        asphalt=colours(3, 0.05, 0.35, 0.05),
        plaster=colours(9, 0.15, 0.9, 0.25),
        brick=colours(5, 0.08, 0.5, 0.35),
        roof=colours(5, 0.03, 0.4, 0.3),
        door=colours(6, 0.02, 0.6, 0.5),
        trim=colours(4, 0.1, 0.9, 0.1),
        foliage=leaves(5),
        car=colours(8, 0.02, 0.9, 0.5),
    )


def any_camera(rng: np.random.Generator) -> Camera:
    """A lens of 45 to 85 degrees, or a panorama."""
    if rng.random() < 0.2:
        return Camera("equirectangular", 1024, 512)
    f = float(rng.uniform(300, 620))
    return Camera("pinhole", 512, 384, f, f, 255.5, 191.5)


def any_pose(rng: np.random.Generator, scene: Scene, drive: Drive, camera: Camera) -> tuple[F64, float]:
    """Somewhere on the vehicle's way, or beside it, looking anywhere but rather along the road; and the time."""
    s = float(rng.uniform(2, scene.layout.axis.length - 2))
    time = float(drive.time_at(s))
    ground, heading = drive.ground(np.array([time]))
    yaw = rng.choice([rng.normal(0, 0.3), rng.normal(np.pi, 0.3), rng.uniform(-np.pi, np.pi)], p=[0.35, 0.15, 0.5])
    pitch, roll = rng.normal(0, 0.12), rng.normal(0, 0.04)
    a = heading[0] + yaw
    forward = np.array([np.cos(a) * np.cos(pitch), np.sin(a) * np.cos(pitch), np.sin(pitch)])
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    right, down = np.cos(roll) * right + np.sin(roll) * down, np.cos(roll) * down - np.sin(roll) * right
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, down, forward], axis=1)
    aside = rng.normal(0, 0.7)
    left = np.array([-np.sin(heading[0]), np.cos(heading[0]), 0])
    pose[:3, 3] = ground[0] + aside * left + [0, 0, rng.uniform(1.5, 3.0)]
    return pose, time


def in_weather(seen: Rendering, rng: np.random.Generator) -> Rendering:
    """Mist before what is far, at times."""
    if rng.random() > 0.3:
        return seen
    weather = Weather(float(np.exp(rng.uniform(np.log(25), np.log(250)))), (0.55, 0.58, 0.62))
    distance = np.where(seen.label == 0, 150.0, np.where(np.isfinite(seen.distance), seen.distance, 150.0))
    clear = np.exp(-distance / weather.reach)[..., None]
    light = seen.light * clear + np.array(weather.colour) * rng.uniform(0.5, 1.1) * (1 - clear)
    return replace(seen, light=light.astype(np.float32))


def street(out: Path, seed: int, images: int) -> int:
    """Write `images` labelled photos of the street of `seed`; returns the seed."""
    import cv2

    rng = np.random.default_rng([seed, 77])
    scene = Scene(lay_out(LENGTH, seed, any_style(rng)))
    drive = plan_drive(scene.layout, 1e6)
    for i in range(images):
        name = f"{seed:05d}_{i:02d}"
        if (out / "labels" / f"{name}.png").is_file():
            continue
        rng = np.random.default_rng([seed, 78, i])
        camera = any_camera(rng)
        pose, time = any_pose(rng, scene, drive, camera)
        seen = in_weather(render(scene, drive, camera, pose, time), rng)
        ev = float(rng.uniform(-0.8, 0.8))
        image = develop(
            seen, ev, Effects(noise=float(rng.uniform(0, 0.01)), vignetting=float(rng.uniform(0, 0.3))), rng
        )
        cv2.imwrite(str(out / "images" / f"{name}.jpg"), image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])
        cv2.imwrite(str(out / "labels" / f"{name}.png"), told(seen, camera, pose))
    return seed


def told(seen: Rendering, camera: Camera, pose: F64) -> U8:
    """Labels (H, W) to learn from: 255, not to be learnt, where a ray leaves the street below the hills."""
    v, u = np.mgrid[: camera.height, : camera.width]
    up = directions(camera, np.stack([u, v], axis=-1)) @ pose[2, :3]
    return np.where((seen.label == 0) & (up < HILLS), 255, seen.label).astype(np.uint8)


def write(out: Path, images: int, seed: int = FIRST_SEED, processes: int | None = None) -> Iterator[float]:
    """Write a training set, going on from what is there; yields the share that is done."""
    for folder in ("images", "labels"):
        (out / folder).mkdir(parents=True, exist_ok=True)
    streets = -(-images // PER_STREET)
    with ProcessPoolExecutor(processes or os.cpu_count()) as pool:
        jobs = [pool.submit(street, out, seed + k, min(PER_STREET, images - k * PER_STREET)) for k in range(streets)]
        for k, job in enumerate(jobs):
            job.result()
            yield (k + 1) / streets


def main() -> None:
    """Write a training set."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--images", type=int, default=1200)
    parser.add_argument("--seed", type=int, default=FIRST_SEED)
    arguments = parser.parse_args()
    for share in write(arguments.out, arguments.images, arguments.seed):
        print(f"\r{share:.0%}", end="", flush=True)
    print()


if __name__ == "__main__":
    main()
