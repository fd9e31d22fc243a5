"""Training images of synthetic streets with labels, for a segmentation network.

`python -m scan2sim.data_samples.training OUT [--images 1200] [--seed 1000]` writes OUT/images/*.jpg, OUT/labels/*.png
(LAS class code per pixel; 0: sky, 255: ignored in training) and OUT/channels/*.png (lidar channels of a perfect scan,
encoded by `segmentation.lidar_channels`, at a quarter of the size). Streets, light, weather, camera and position are
randomized far beyond the streets of tests and benchmarks. Seeds from 1000 on are reserved for training, smaller ones
for everything else.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from scan2sim.data_samples import paints
from scan2sim.data_samples.layout import Layout, Style, lay_out
from scan2sim.data_samples.paints import RGB
from scan2sim.data_samples.photos import Effects, Rendering, develop, directions, render
from scan2sim.data_samples.scanner import Drive, plan_drive
from scan2sim.data_samples.scene import Scene
from scan2sim.data_samples.variety import varied
from scan2sim.pipeline.core.types import F64, U8, Camera
from scan2sim.segmentation.lidar_channels import DOWNSAMPLING, GroundLevel, encode, ground_level

IMAGES_PER_STREET = 20
STREET_LENGTH_M = 80.0
CLEARANCE_M = 1.2
"""Least distance of most surfaces from a camera, so that none is inside a van."""
HILL_SINE_MAX = 0.11
"""Sine of the elevation above which there is only sky beyond the street."""
FIRST_SEED = 1000
"""First seed of training streets."""


@dataclass(frozen=True)
class Weather:
    """Fog: distance in which it covers all but 1/e of a surface's light, metres, and its colour."""

    visibility: float
    colour: RGB


def random_style(rng: np.random.Generator) -> Style:
    """Random style: colours, proportions, season and light of a street."""

    def near(value: float) -> tuple[float, float]:
        return (value, value * 1.02 + 1e-6)

    def colours(n: int, low: float, high: float, tint: float) -> tuple[RGB, ...]:
        """Greys of linear light in [low, high], tinted."""
        grey = np.exp(rng.uniform(np.log(low), np.log(high), (n, 1)))
        rgb = np.clip(grey * np.exp(rng.normal(0, tint, (n, 3))), 0.005, 0.95)
        return tuple((float(r), float(g), float(b)) for r, g, b in rgb)

    def leaves(n: int) -> tuple[RGB, ...]:
        """Colours of foliage, from dark green to yellow and brown."""
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


def random_street(seed: int) -> Layout:
    """Random street: four fifths with all variations (`variety.varied`), the others without."""
    rng = np.random.default_rng([seed, 77])
    style = random_style(rng)
    if rng.random() < 0.2:
        return lay_out(STREET_LENGTH_M, seed, style)
    dark = rng.random() < 0.4  # dark shadows, as in photos
    style = replace(
        style,
        pavement=float(rng.uniform(1.6, 4.5)),
        kerb=float(rng.choice([0.02, 0.05, 0.09, 0.12, 0.15])),
        sky_strength=(0.08, 0.25) if dark else style.sky_strength,
    )
    return varied(lay_out(STREET_LENGTH_M, seed, style), STREET_LENGTH_M)


def random_camera(rng: np.random.Generator) -> Camera:
    """Random camera: a lens of 45 to 85 degrees, a wide image as of cameras in cars, or a panorama."""
    kind = rng.random()
    if kind < 0.15:
        return Camera("equirectangular", 1024, 512)
    if kind < 0.5:
        f = float(rng.uniform(360, 620))
        return Camera("pinhole", 768, 256, f, f, 383.5, float(rng.uniform(100, 155)))
    f = float(rng.uniform(300, 620))
    return Camera("pinhole", 512, 384, f, f, 255.5, 191.5)


def random_pose(rng: np.random.Generator, scene: Scene, drive: Drive) -> tuple[F64, float]:
    """Random pose (4, 4) on or beside the vehicle's path, preferably looking along the road, and its GPS time."""
    length = scene.layout.axis.length
    s = float(rng.uniform(2, length - 2))
    yaw = rng.choice([rng.normal(0, 0.3), rng.normal(np.pi, 0.3), rng.uniform(-np.pi, np.pi)], p=[0.45, 0.15, 0.4])
    if np.cos(yaw) * (s - length / 2) > 0.15 * length:  # don't look out of the street
        s = length - s
    time = float(drive.time_at(s))
    ground, heading = drive.ground(np.array([time]))
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
    pose[:3, 3] = ground[0] + aside * left + [0, 0, rng.uniform(1.4, 3.0)]
    return pose, time


def with_fog(seen: Rendering, rng: np.random.Generator) -> Rendering:
    """Rendering with random fog in 30 % of the cases."""
    if rng.random() > 0.3:
        return seen
    weather = Weather(float(np.exp(rng.uniform(np.log(25), np.log(250)))), (0.55, 0.58, 0.62))
    distance = np.where(seen.classification == 0, 150.0, np.where(np.isfinite(seen.distance), seen.distance, 150.0))
    transmission = np.exp(-distance / weather.visibility)[..., None]
    light = seen.light * transmission + np.array(weather.colour) * rng.uniform(0.5, 1.1) * (1 - transmission)
    return replace(seen, light=light.astype(np.float32))


def street(out: Path, seed: int, images: int) -> int:
    """Write `images` labelled photos of the street of `seed`; returns the seed."""
    import cv2

    scene = Scene(random_street(seed))
    drive, ground = plan_drive(scene.layout, 1e6), _ground(scene)
    for i in range(images):
        name = f"{seed:05d}_{i:02d}"
        if (out / "labels" / f"{name}.png").is_file():
            continue
        rng = np.random.default_rng([seed, 78, i])
        camera = random_camera(rng)
        pose, time = random_pose(rng, scene, drive)
        while _blocked(scene, camera, pose):
            pose, time = random_pose(rng, scene, drive)
        seen = with_fog(render(scene, drive, camera, pose, time), rng)
        ev = float(rng.uniform(-0.8, 0.8))
        image = develop(
            seen, ev, Effects(noise=float(rng.uniform(0, 0.01)), vignetting=float(rng.uniform(0, 0.3))), rng
        )
        cv2.imwrite(str(out / "images" / f"{name}.jpg"), image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])
        cv2.imwrite(str(out / "channels" / f"{name}.png"), scanned(scene, drive, ground, camera, pose, time, rng))
        cv2.imwrite(str(out / "labels" / f"{name}.png"), class_map(seen, camera, pose))
    return seed


def _blocked(scene: Scene, camera: Camera, pose: F64) -> bool:
    """Whether more than a quarter of the image shows surfaces nearer than `CLEARANCE_M`."""
    v, u = np.mgrid[: camera.height : 16, : camera.width : 16]
    rays = (directions(camera, np.stack([u, v], axis=-1)).reshape(-1, 3) @ pose[:3, :3].T).astype(np.float32)
    origins = np.broadcast_to(pose[:3, 3].astype(np.float32), rays.shape)
    return bool((scene.cast(origins, rays).distance < CLEARANCE_M).mean() > 0.25)


def _ground(scene: Scene) -> GroundLevel:
    """Ground level of the street."""
    part = scene.surface
    on = np.isin(part.classification, (paints.ROAD, paints.SIDEWALK, paints.TERRAIN))
    return ground_level(part.vertices[np.unique(part.faces[on])])


def scanned(
    scene: Scene, drive: Drive, ground: GroundLevel, camera: Camera, pose: F64, time: float, rng: np.random.Generator
) -> U8:
    """(h, w, 4) lidar channels of a perfect scan from the photo's pose, mostly without the moving car."""
    small = camera.scaled(1 / DOWNSAMPLING)
    v, u = np.mgrid[: small.height, : small.width]
    rays = directions(small, np.stack([u, v], axis=-1)).reshape(-1, 3) @ pose[:3, :3].T
    origins = np.broadcast_to(pose[:3, 3].astype(np.float32), rays.shape)
    car = drive.car(scene, np.array([time])).repeated(len(rays)) if rng.random() < 0.3 else None
    hits = scene.cast(origins, rays.astype(np.float32), car)
    corners = scene.surface.vertices[scene.surface.faces[hits.face]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    up = np.abs(normal[:, 2]) / np.maximum(np.linalg.norm(normal, axis=1), 1e-9)
    hit_place = np.where(hits.hit, hits.distance, 0)[:, None] * rays + origins
    codes = encode(ground.above(hit_place.astype(np.float32)), hits.distance, up.astype(np.float32))
    return codes.reshape(small.height, small.width, -1)


def class_map(seen: Rendering, camera: Camera, pose: F64) -> U8:
    """Labels (H, W) for training: 255 (ignored) where a ray leaves the street below the hills' elevation."""
    v, u = np.mgrid[: camera.height, : camera.width]
    up = directions(camera, np.stack([u, v], axis=-1)) @ pose[2, :3]
    return np.where((seen.classification == 0) & (up < HILL_SINE_MAX), 255, seen.classification).astype(np.uint8)


def write(out: Path, images: int, seed: int = FIRST_SEED, processes: int | None = None) -> Iterator[float]:
    """Write a training set, or complete an existing one; yields the share that is done.

    Args:
        out: output folder.
        images: number of images.
        seed: seed of the first street.
        processes: number of worker processes; None: one per CPU core.
    """
    for folder in ("images", "labels", "channels"):
        (out / folder).mkdir(parents=True, exist_ok=True)
    streets = -(-images // IMAGES_PER_STREET)
    with ProcessPoolExecutor(processes or os.cpu_count()) as pool:
        jobs = [
            pool.submit(street, out, seed + k, min(IMAGES_PER_STREET, images - k * IMAGES_PER_STREET))
            for k in range(streets)
        ]
        for k, job in enumerate(jobs):
            job.result()
            yield (k + 1) / streets


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="output folder")
    parser.add_argument("--images", type=int, default=1200, help="number of images (default: 1200)")
    parser.add_argument("--seed", type=int, default=FIRST_SEED, help="seed of the first street (default: 1000)")
    arguments = parser.parse_args()
    for share in write(arguments.out, arguments.images, arguments.seed):
        print(f"\r{share:.0%}", end="", flush=True)
    print()


if __name__ == "__main__":
    main()
