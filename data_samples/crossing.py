"""Render videos of level crossings with trains and cars that pass, brake, stand and start, and their ground truth.

`python -m scan2sim.data_samples.crossing OUT [--views 10] [--frames 1000] [--seed 0]` writes OUT/view_00.mp4 and so on,
at 25 frames per second, and OUT/truth.jsonl, one line per frame: view, frame, time (seconds), light ("day" or "dusk"),
and for each object within the image its class, track id, box (x0, y0, x1, y1 in pixels, including occluded parts),
visible share, speed (m/s) and whether it moves (at `crossing_traffic.MOVING_SPEED_MIN` or faster).

Each view shows another crossing from another camera on a mast that sways in the wind. Seeds from `training.FIRST_SEED`
on are reserved for training.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scan2sim.data_samples import junction
from scan2sim.data_samples.crossing_traffic import MOVING_SPEED_MIN, Traffic, random_density
from scan2sim.data_samples.drive import encode
from scan2sim.data_samples.layout import Style
from scan2sim.data_samples.objects import lamp
from scan2sim.data_samples.shapes import join
from scan2sim.data_samples.stage import Backdrop, Frame, Light, Stage, centred_shake, with_margin
from scan2sim.pipeline.core.step import Report, silent
from scan2sim.pipeline.core.types import F64, U8, Camera

FPS = 25.0
FRAME_SIZE_PX = (640, 360)
SHAKE_MARGIN_PX = 24
"""Border of the backdrop around a frame, for the camera's motion."""
BITRATE_BPS = 2.5e6

Rng = np.random.Generator


@dataclass(frozen=True)
class View:
    """A camera at a crossing.

    Attributes:
        stage: renderer of the crossing.
        backdrop: static image of the camera.
        traffic: moving objects.
        light: "day" or "dusk".
        sway, turn: amplitudes of the mast's motion: pixels, radians.
        noise: standard deviation of the sensor noise, in 8-bit levels.
        seed: seed of motion and noise.
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
        """(2, 3) affine transform from a frame's pixels to the backdrop's at a time in seconds."""
        rng = np.random.default_rng([self.seed, 72])
        frequency, phase = rng.uniform(0.25, 2.6, (3, 4)), rng.uniform(0, 2 * np.pi, (3, 4))
        x, y, turn = np.sin(2 * np.pi * frequency * time + phase).sum(axis=1) / 2
        return centred_shake(self.backdrop, FRAME_SIZE_PX, self.turn * turn, (self.sway * x, 0.6 * self.sway * y))

    def frame(self, index: int) -> Frame:
        """Frame `index` with sensor noise, and its ground truth."""
        rendered = self.stage.frame(self.backdrop, self.traffic.at(index), FRAME_SIZE_PX, self.shake(index / FPS))
        grain = np.random.default_rng([self.seed, 73, index])
        return Frame(with_sensor_noise(rendered.rgb, self.noise, grain), rendered.visible, rendered.owner)


def random_light(rng: Rng, hour: str) -> Light:
    """Random light of a clear or cloudy day, or of dusk; `hour`: "day" or "dusk"."""
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


def random_camera(rng: Rng, at: junction.Junction, size: tuple[int, int] = FRAME_SIZE_PX) -> tuple[Camera, F64, F64]:
    """Random camera on a mast that looks at the crossing: intrinsics, pose (4, 4), and the point that it looks at."""
    while True:
        distance, azimuth = float(np.exp(rng.uniform(np.log(16), np.log(75)))), rng.uniform(0, 2 * np.pi)
        xy = distance * np.array([np.cos(azimuth), np.sin(azimuth)])
        if at.clearance(xy) > 3.0:
            break
    position = np.array([*xy, rng.uniform(3.0, 5.0) + 0.11 * distance * rng.random()])
    aim = np.array([*rng.normal(0, 3.0, 2) + [0, at.tracks[-1] / 2], rng.uniform(0.5, 2.5)])
    view_width = rng.uniform(17, 50)  # metres, at the distance of the crossing
    f = float(np.clip(size[0] * distance / view_width, 0.6 * size[0], 2.6 * size[0]))
    camera = Camera("pinhole", *size, f, f, (size[0] - 1) / 2, (size[1] - 1) / 2)
    return camera, look_at_pose(position, aim, float(rng.normal(0, 0.012))), aim


def look_at_pose(position: F64, aim: F64, roll: float = 0.0) -> F64:
    """(4, 4) pose, camera to world, of a camera at `position` (3,) that looks at `aim` (3,); `roll`: radians."""
    forward = (aim - position) / np.linalg.norm(aim - position)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    right, down = np.cos(roll) * right + np.sin(roll) * down, np.cos(roll) * down - np.sin(roll) * right
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([right, down, forward], axis=1), position
    return pose


def with_sensor_noise(rgb: U8, sigma: float, rng: Rng) -> U8:
    """Image (H, W, 3) with sensor noise of standard deviation `sigma`, in 8-bit levels."""
    import cv2

    grain = np.empty((*rgb.shape[:2], 3), np.int8)
    cv2.setRNGSeed(int(rng.integers(1 << 30)))
    cv2.randn(grain, (0, 0, 0), (sigma, sigma, sigma))
    return np.asarray(cv2.add(rgb, grain, dtype=cv2.CV_8U), np.uint8)


def view(seed: int, index: int, seconds: float, style: Style | None = None) -> View:
    """View `index` of a set; odd ones are at dusk.

    Args:
        seed: seed of the set.
        index: index of the view.
        seconds: duration of the traffic.
        style: colours of the surroundings; None: the default.
    """
    rng = np.random.default_rng([seed, 71, index])
    hour = "dusk" if index % 2 else "day"
    light = random_light(rng, hour)
    at = junction.build(rng, style or Style())
    stage = Stage(at.part, light, seed % 1000)
    for _ in range(30):
        camera, pose, aim = random_camera(rng, at)
        distances, aim_distance = stage.distances(camera, pose), np.linalg.norm(aim - pose[:3, 3])
        if (distances[distances.shape[0] // 3 :] < 0.5 * aim_distance).mean() < 0.12:  # not blocked
            break
    if rng.random() < 0.4:  # a post that occludes a part of the view
        between = pose[:3, 3] + float(rng.uniform(0.3, 0.6)) * (aim - pose[:3, 3])
        post = lamp().moved(float(rng.uniform(0, 6)), (*(between[:2] + rng.normal(0, 1.5, 2)), 0.0))
        stage = Stage(join([at.part, post]), light, seed % 1000)
    traffic = Traffic(at, seconds, random_density(rng), rng)
    noise = rng.uniform(2.5, 5) if hour == "dusk" else rng.uniform(0.5, 2.5)
    backdrop = stage.backdrop(with_margin(camera, SHAKE_MARGIN_PX), pose)
    sway, turn = float(rng.uniform(0.4, 2.5)), float(np.radians(rng.uniform(0.03, 0.25)))
    return View(stage, backdrop, traffic, hour, sway, turn, float(noise), 1000 * seed + index)


def labels(frame: Frame) -> list[dict[str, object]]:
    """Ground truth of the objects in a frame, as written to `truth.jsonl`."""
    return [
        {
            "class": s.actor.label, "track": s.actor.track, "box": list(s.box), "visible": s.visible,
            "speed": round(s.actor.speed, 3), "moving": s.actor.speed >= MOVING_SPEED_MIN,
        }
        for s in frame.visible
    ]  # fmt: skip


def film(out: Path, views: int = 10, frames: int = 1000, seed: int = 0, report: Report = silent) -> None:
    """Write videos of `views` views with `frames` frames each, and their ground truth."""
    out.mkdir(parents=True, exist_ok=True)
    with (out / "truth.jsonl").open("w", encoding="utf-8") as file:
        for number in range(views):
            current = view(seed, number, frames / FPS)

            def images(number: int = number, current: View = current) -> Iterator[U8]:
                for index in range(frames):
                    report((number + index / frames) / views, f"view {number}, frame {index}")
                    frame = current.frame(index)
                    line = {"view": number, "frame": index, "time": index / FPS, "light": current.light}
                    file.write(json.dumps({**line, "objects": labels(frame)}) + "\n")
                    yield frame.rgb

            encode(images(), out / f"view_{number:02d}.mp4", FPS, BITRATE_BPS, FRAME_SIZE_PX)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="output folder")
    parser.add_argument("--views", type=int, default=10, help="number of views (default: 10)")
    parser.add_argument("--frames", type=int, default=1000, help="number of frames per view (default: 1000)")
    parser.add_argument("--seed", type=int, default=0, help="seed of all views (default: 0)")
    a = parser.parse_args()

    def report(fraction: float, message: str = "") -> None:
        print(f"\r{fraction:6.1%}  {message:30}", end="", flush=True)

    film(a.out, a.views, a.frames, a.seed, report)
    print()


if __name__ == "__main__":
    main()
