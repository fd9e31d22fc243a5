"""Film level crossings: trains and cars that pass, brake, stand and start, with their boxes and speeds.

`python -m scan2sim.data_samples.crossing OUT [--views 10] [--frames 1000] [--seed 0]` writes OUT/view_00.mp4 and so on,
25 frames a second, and OUT/truth.jsonl, a line a frame: view, frame, time (seconds), light ("day" or "dusk"), and of
each thing that lies within the picture its class, track id, box (x0, y0, x1, y1 in pixels: all of it, whether hidden or
not), visible share, speed (m/s) and whether it moves (at `crossing_traffic.STANDS` or faster).

Each view is of a crossing of its own, by a camera of its own on a mast in the wind. Seeds from `training.FIRST_SEED` on
are kept for training.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scan2sim.data_samples import junction
from scan2sim.data_samples.crossing_traffic import STANDS, Traffic, any_busy
from scan2sim.data_samples.drive import encode
from scan2sim.data_samples.layout import Style
from scan2sim.data_samples.objects import lamp
from scan2sim.data_samples.shapes import join
from scan2sim.data_samples.stage import Backdrop, Frame, Light, Stage, middle, wider
from scan2sim.pipeline.core.step import Report, silent
from scan2sim.pipeline.core.types import F64, U8, Camera

FPS = 25.0
SIZE = (640, 360)
MARGIN = 24
"""Pixels around a picture that its backdrop has, for the camera to shake in."""
BITRATE = 2.5e6

Rng = np.random.Generator


@dataclass(frozen=True)
class View:
    """A camera before a crossing.

    Attributes:
        light: "day" or "dusk".
        sway, turn: amplitudes of the mast's motion: pixels, radians.
        noise: of the sensor, standard deviation, of 255.
    """

    stage: Stage
    backdrop: Backdrop
    traffic: Traffic
    light: str
    sway: float
    turn: float
    noise: float
    seed: int

    def shake(self, time: float) -> F64:
        """(2, 3) from a picture's pixels to the backdrop's."""
        rng = np.random.default_rng([self.seed, 72])
        frequency, phase = rng.uniform(0.25, 2.6, (3, 4)), rng.uniform(0, 2 * np.pi, (3, 4))
        x, y, turn = np.sin(2 * np.pi * frequency * time + phase).sum(axis=1) / 2
        return middle(self.backdrop, SIZE, self.turn * turn, (self.sway * x, 0.6 * self.sway * y))

    def frame(self, index: int) -> Frame:
        """A picture, as the sensor has it."""
        shown = self.stage.frame(self.backdrop, self.traffic.at(index), SIZE, self.shake(index / FPS))
        grain = np.random.default_rng([self.seed, 73, index])
        return Frame(noisy(shown.rgb, self.noise, grain), shown.seen, shown.owner)


def any_light(rng: Rng, hour: str) -> Light:
    """Of a clear or cloudy day, or of dusk."""
    azimuth = rng.uniform(0, 2 * np.pi)
    exposure = rng.uniform(0.36, 0.5)
    if hour == "dusk":
        elevation, sun, sky, cloudy = rng.uniform(2, 7), rng.uniform(0, 0.1), 0.13, rng.uniform(0.3, 1)
        exposure = rng.uniform(0.18, 0.28)
    elif rng.random() < 0.4:
        elevation, sun, sky, cloudy = 40.0, rng.uniform(0.02, 0.15), rng.uniform(0.5, 0.9), 0.95
    else:
        elevation, sun, sky, cloudy = rng.uniform(14, 60), rng.uniform(0.6, 1.05), rng.uniform(0.2, 0.45), 0.4
    e = np.radians(elevation)
    towards = np.array([np.cos(azimuth) * np.cos(e), np.sin(azimuth) * np.cos(e), np.sin(e)])
    return Light(towards, float(sun), float(sky), float(cloudy), float(exposure))


def any_camera(rng: Rng, at: junction.Junction, size: tuple[int, int] = SIZE) -> tuple[Camera, F64, F64]:
    """A camera on a mast that looks at the crossing: intrinsics, pose, and the place that it looks at."""
    while True:
        distance, azimuth = float(np.exp(rng.uniform(np.log(16), np.log(75)))), rng.uniform(0, 2 * np.pi)
        xy = distance * np.array([np.cos(azimuth), np.sin(azimuth)])
        if at.clear(xy) > 3.0:
            break
    place = np.array([*xy, rng.uniform(3.0, 5.0) + 0.11 * distance * rng.random()])
    aim = np.array([*rng.normal(0, 3.0, 2) + [0, at.tracks[-1] / 2], rng.uniform(0.5, 2.5)])
    wide = rng.uniform(17, 50)
    f = float(np.clip(size[0] * distance / wide, 0.6 * size[0], 2.6 * size[0]))
    camera = Camera("pinhole", *size, f, f, (size[0] - 1) / 2, (size[1] - 1) / 2)
    return camera, looking(place, aim, float(rng.normal(0, 0.012))), aim


def looking(place: F64, aim: F64, roll: float = 0.0) -> F64:
    """(4, 4) pose of a camera at `place` that looks at `aim`."""
    forward = (aim - place) / np.linalg.norm(aim - place)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    right, down = np.cos(roll) * right + np.sin(roll) * down, np.cos(roll) * down - np.sin(roll) * right
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([right, down, forward], axis=1), place
    return pose


def noisy(rgb: U8, spread: float, rng: Rng) -> U8:
    """With a sensor's noise."""
    import cv2

    grain = np.empty((*rgb.shape[:2], 3), np.int8)
    cv2.setRNGSeed(int(rng.integers(1 << 30)))
    cv2.randn(grain, (0, 0, 0), (spread, spread, spread))
    return np.asarray(cv2.add(rgb, grain, dtype=cv2.CV_8U), np.uint8)


def view(seed: int, index: int, seconds: float, style: Style | None = None) -> View:
    """The view `index` of a set: every second one at dusk."""
    rng = np.random.default_rng([seed, 71, index])
    hour = "dusk" if index % 2 else "day"
    light = any_light(rng, hour)
    at = junction.build(rng, style or Style())
    stage = Stage(at.part, light, seed % 1000)
    for _ in range(30):
        camera, pose, aim = any_camera(rng, at)
        near, far = stage.clear(camera, pose), np.linalg.norm(aim - pose[:3, 3])
        if (near[near.shape[0] // 3 :] < 0.5 * far).mean() < 0.12:
            break
    if rng.random() < 0.4:  # something between
        between = pose[:3, 3] + float(rng.uniform(0.3, 0.6)) * (aim - pose[:3, 3])
        post = lamp().moved(float(rng.uniform(0, 6)), (*(between[:2] + rng.normal(0, 1.5, 2)), 0.0))
        stage = Stage(join([at.part, post]), light, seed % 1000)
    traffic = Traffic(at, seconds, any_busy(rng), rng)
    noise = rng.uniform(2.5, 5) if hour == "dusk" else rng.uniform(0.5, 2.5)
    backdrop = stage.backdrop(wider(camera, MARGIN), pose)
    sway, turn = float(rng.uniform(0.4, 2.5)), float(np.radians(rng.uniform(0.03, 0.25)))
    return View(stage, backdrop, traffic, hour, sway, turn, float(noise), 1000 * seed + index)


def told(frame: Frame) -> list[dict[str, object]]:
    """What is written of the things in a picture."""
    return [
        {
            "class": s.actor.label, "track": s.actor.track, "box": list(s.box), "visible": s.visible,
            "speed": round(s.actor.speed, 3), "moving": s.actor.speed >= STANDS,
        }
        for s in frame.seen
    ]  # fmt: skip


def film(out: Path, views: int = 10, frames: int = 1000, seed: int = 0, report: Report = silent) -> None:
    """Write films of views, and their truth."""
    out.mkdir(parents=True, exist_ok=True)
    with (out / "truth.jsonl").open("w", encoding="utf-8") as file:
        for number in range(views):
            shown = view(seed, number, frames / FPS)

            def pictures(number: int = number, shown: View = shown) -> Iterator[U8]:
                for index in range(frames):
                    report((number + index / frames) / views, f"view {number}, frame {index}")
                    frame = shown.frame(index)
                    line = {"view": number, "frame": index, "time": index / FPS, "light": shown.light}
                    file.write(json.dumps({**line, "things": told(frame)}) + "\n")
                    yield frame.rgb

            encode(pictures(), out / f"view_{number:02d}.mp4", FPS, BITRATE, SIZE)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--views", type=int, default=10)
    parser.add_argument("--frames", type=int, default=1000, help="of each view")
    parser.add_argument("--seed", type=int, default=0)
    a = parser.parse_args()

    def report(fraction: float, message: str = "") -> None:
        print(f"\r{fraction:6.1%}  {message:30}", end="", flush=True)

    film(a.out, a.views, a.frames, a.seed, report)
    print()


if __name__ == "__main__":
    main()
