"""Training images of streets and level crossings with boxes around vehicles and people, for an object detector.

`python -m scan2sim.data_samples.boxes OUT [--images 3000] [--seed 1000]` writes OUT/images/*.jpg, OUT/classes.json (the
class names) and OUT/boxes.jsonl, one line per image: its name, and for each object the class, the box (x0, y0, x1, y1
in pixels, clipped to the image, including occluded parts) and the visible share. Locations, light, cameras and
appearance are randomized far beyond other data sets; seeds from `training.FIRST_SEED` on are reserved for training.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from scan2sim.data_samples import junction, scene
from scan2sim.data_samples.crossing import look_at_pose, random_camera, random_light, with_sensor_noise
from scan2sim.data_samples.crossing_traffic import Traffic, TrafficDensity
from scan2sim.data_samples.fleet import CLASSES, random_road_user
from scan2sim.data_samples.layout import HALF_WIDTH, Layout
from scan2sim.data_samples.stage import Actor, Backdrop, Body, Frame, Light, Piece, Stage
from scan2sim.data_samples.training import FIRST_SEED, random_street, random_style
from scan2sim.pipeline.core.types import F64, Camera

VIEWS_PER_PLACE = 6
"""Number of camera views of a location, each with `IMAGES_PER_VIEW` images of different traffic."""
IMAGES_PER_VIEW = 5
CROSSING_SHARE = 0.5
"""Share of locations that are crossings; the others are streets."""
IMAGE_SIZES_PX = ((640, 360), (640, 384), (640, 480), (768, 256))
VISIBLE_PIXELS_MIN = 12
"""Number of visible pixels that an object needs to be labelled."""

Rng = np.random.Generator


def place(out: Path, seed: int) -> list[str]:
    """Write the images of a location; returns their lines of `boxes.jsonl`."""
    rng = np.random.default_rng([seed, 81])
    lines = []
    for i, (frame, noise) in enumerate(_crossing(seed, rng) if rng.random() < CROSSING_SHARE else _street(seed, rng)):
        name = f"{seed:05d}_{i:02d}.jpg"
        _save(out / "images" / name, frame, noise, rng)
        labels = [
            {"class": s.actor.label, "box": list(s.box), "visible": s.visible}
            for s in frame.visible if s.pixels >= VISIBLE_PIXELS_MIN
        ]  # fmt: skip
        lines.append(json.dumps({"image": name, "objects": labels}) + "\n")
    return lines


def _save(file: Path, frame: Frame, noise: float, rng: Rng) -> None:
    import cv2

    cv2.imwrite(str(file), with_sensor_noise(frame.rgb, noise, rng)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])


def _crossing(seed: int, rng: Rng) -> Iterator[tuple[Frame, float]]:
    at = junction.build(rng, random_style(rng))
    stage = Stage(at.part, random_light(rng, "dusk" if rng.random() < 0.3 else "day"), seed % 1000)
    density = TrafficDensity(float(rng.uniform(2, 5)), float(rng.uniform(0, 3)), rng.random() < 0.5, 6, 4)
    traffic = Traffic(at, 120.0, density, rng)
    for _ in range(VIEWS_PER_PLACE):
        camera, pose, aim = random_camera(rng, at, IMAGE_SIZES_PX[rng.integers(len(IMAGE_SIZES_PX))])
        if (stage.distances(camera, pose) < 0.3 * np.linalg.norm(aim - pose[:3, 3])).mean() > 0.4:
            continue
        backdrop, noise = stage.backdrop(camera, pose, 1), float(rng.uniform(0.5, 4))
        for index in rng.integers(0, len(traffic.times), IMAGES_PER_VIEW):
            yield stage.frame(backdrop, traffic.at(int(index)), (camera.width, camera.height)), noise


def _street(seed: int, rng: Rng) -> Iterator[tuple[Frame, float]]:
    layout = random_street(seed)
    static = replace(layout, parked=(), extras=tuple(m for m in layout.extras if not m.movable))
    light = Light(
        layout.sun, layout.sun_strength, layout.sky_strength, layout.cloudiness, float(rng.uniform(0.25, 0.5))
    )
    stage = Stage(scene.build(static)[0], light, seed % 1000)
    pool = _pool(rng)
    for _ in range(VIEWS_PER_PLACE):
        backdrop = _view(stage, layout, rng)
        for _ in range(IMAGES_PER_VIEW):
            actors = _in_street(layout, pool, rng)
            # none right in front of the camera
            distant = [a for a in actors if np.linalg.norm(a.pieces[0].position - backdrop.T_world_cam[:3, 3]) > 4.5]
            size = (backdrop.camera.width, backdrop.camera.height)
            yield stage.frame(backdrop, distant, size), float(rng.uniform(0, 3))


def _pool(rng: Rng) -> dict[str, list[Body]]:
    counts = {"car": 10, "van": 3, "truck": 2, "bus": 2, "person": 5, "cyclist": 2}
    return {label: [Body(random_road_user(label, rng)) for _ in range(n)] for label, n in counts.items()}


def _view(stage: Stage, layout: Layout, rng: Rng) -> Backdrop:
    """Random view in a street by a camera on a car or a mast, along or across the street."""
    width, height = IMAGE_SIZES_PX[rng.integers(len(IMAGE_SIZES_PX))]
    while True:
        f = float(rng.uniform(0.55, 1.3) * width)
        camera = Camera("pinhole", width, height, f, f, (width - 1) / 2, (height - 1) / 2)
        s, low = float(rng.uniform(2, layout.axis.length - 2)), rng.random() < 0.65
        t = float(rng.uniform(-layout.lane, layout.lane) if low else rng.uniform(-HALF_WIDTH, HALF_WIDTH) / 2)
        xy, heading = layout.axis.place(s, t)
        up = float(rng.uniform(1.2, 2.6) if low else rng.uniform(3, 9))
        ahead = float(heading) + (0.0 if s < layout.axis.length / 2 else np.pi) + float(rng.normal(0, 0.35))
        position = np.array([*xy, float(layout.height(s, t)) + up])
        far = float(rng.uniform(12, 40))
        aim = position + [far * np.cos(ahead), far * np.sin(ahead), far * rng.normal(0, 0.07) - (0 if low else up)]
        pose = look_at_pose(position, aim, float(rng.normal(0, 0.03)))
        if (stage.distances(camera, pose) < 2.0).mean() < 0.2:
            return stage.backdrop(camera, pose, 1)


def _in_street(layout: Layout, pool: dict[str, list[Body]], rng: Rng) -> list[Actor]:
    """Random vehicles along the kerbs and in the lanes, people on the pavements and the road."""
    actors: list[Actor] = []

    def add(label: str, s: float, t: float, turn: float) -> None:
        xy, heading = layout.axis.place(s, t)
        body = pool[label][rng.integers(len(pool[label]))]
        at: F64 = np.array([*xy, float(layout.height(s, t))])
        actors.append(Actor(label, len(actors), (Piece(body, at, float(heading) + turn),)))

    def vehicle() -> str:
        return str(rng.choice(["car", "van", "truck", "bus"], p=[0.72, 0.13, 0.09, 0.06]))

    for side in (-1, 1):
        for t, gap in ((side * (layout.kerb(side) - 1.0), 8.0), (side * layout.lane / 2, rng.uniform(15, 60))):
            if t * side > layout.lane / 2 and abs(t) - layout.lane / 2 < 2.1:
                continue  # no room to park
            s = float(rng.uniform(0, gap))
            dense = rng.uniform(0.15, 1)
            while s < layout.axis.length:
                label = vehicle()
                if rng.random() < (dense if gap == 8.0 else 1.0):
                    way = np.pi if side == 1 else 0.0
                    add(label, s, t, way + float(rng.normal(0, 0.04)) + (np.pi if rng.random() < 0.2 else 0.0))
                s += gap * float(rng.uniform(0.9, 1.6)) + {"truck": 7, "bus": 8, "van": 1}.get(label, 0)
    for _ in range(int(rng.integers(0, 14))):
        label, side = ("person", "person", "cyclist")[rng.integers(3)], int(rng.choice([-1, 1]))
        near, far = layout.kerb(side), layout.garden(side)
        t = float(rng.uniform(near, far) if rng.random() < 0.75 and label == "person" else rng.uniform(0, near))
        add(label, float(rng.uniform(0, layout.axis.length)), side * t, float(rng.uniform(-np.pi, np.pi)))
    return actors


def write(out: Path, images: int, seed: int = FIRST_SEED, processes: int | None = None) -> Iterator[float]:
    """Write a data set, or complete an existing one; yields the share that is done.

    Args:
        out: output folder.
        images: number of images.
        seed: seed of the first location.
        processes: number of worker processes; None: one per CPU core.
    """
    (out / "images").mkdir(parents=True, exist_ok=True)
    (out / "classes.json").write_text(json.dumps(CLASSES), encoding="utf-8")
    index, count = out / "boxes.jsonl", -(-images // (VIEWS_PER_PLACE * IMAGES_PER_VIEW))
    lines = index.read_text(encoding="utf-8").splitlines() if index.is_file() else []
    existing = {int(json.loads(line)["image"].split("_")[0]) for line in lines}
    todo = [seed + k for k in range(count) if seed + k not in existing]
    spawn = get_context("spawn")  # a process forked after OpenMP was started would crash
    with ProcessPoolExecutor(processes or os.cpu_count(), spawn) as pool, index.open("a", encoding="utf-8") as file:
        for k, new_lines in enumerate(pool.map(place, [out] * len(todo), todo)):
            file.writelines(new_lines)
            file.flush()
            yield (k + 1) / len(todo)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="output folder")
    parser.add_argument("--images", type=int, default=3000, help="number of images (default: 3000)")
    parser.add_argument("--seed", type=int, default=FIRST_SEED, help="seed of the first location (default: 1000)")
    parser.add_argument("--processes", type=int, help="number of worker processes (default: one per CPU core)")
    arguments = parser.parse_args()
    for share in write(arguments.out, arguments.images, arguments.seed, arguments.processes):
        print(f"\r{share:.0%}", end="", flush=True)
    print()


if __name__ == "__main__":
    main()
