"""What a vehicle's video costs: processor time of each step from a finished world's street to what the driver sees.

    python -m bench.teleop.video WORLD [--pictures 150] [--bitrate 1500000]

Four cameras of 640x480 drive along the world's recorded path at 30 pictures/s, as fast as they can be computed; packets
go from one side to the other without a network. Times are of the processor, not of the clock on the wall.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from scan2sim.pipeline.camera.renderer import pinhole
from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.io.worlds.scene import PATH, read_scene
from scan2sim.services.teleoperation import encoders
from scan2sim.services.teleoperation.cameras import Mount, Picture
from scan2sim.services.teleoperation.cameras.world import mount
from scan2sim.services.teleoperation.sim.world_renderer import Eye, world
from scan2sim.services.teleoperation.video import timecode
from scan2sim.services.teleoperation.video.capture import Coder
from scan2sim.services.teleoperation.video.jitter_buffer import Frame, Watcher
from scan2sim.services.teleoperation.video.rate_control import Plan
from scan2sim.services.teleoperation.video.srtp_session import Keys

FPS, YAWS = 30, (0, 90, -90, 180)


def street(folder: Path, count: int) -> list[F64]:
    """Poses (4, 4) of a vehicle along the path that the first tile was recorded on, evenly."""
    scene = read_scene(folder)
    with np.load(scene.tiles[0].known[PATH]) as path:
        places = path["positions"] + scene.tiles[0].offset
    at = np.linspace(0, len(places) - 2, count)
    along = np.column_stack([np.interp(at, np.arange(len(places)), places[:, k]) for k in range(3)])
    heading = np.unwrap(np.arctan2(*np.gradient(cv2.blur(along[:, :2].copy(), (1, 15)), axis=0).T[::-1]))
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 0], poses[:, 0, 1] = np.cos(heading), -np.sin(heading)
    poses[:, 1, 0], poses[:, 1, 1] = np.sin(heading), np.cos(heading)
    poses[:, :3, 3] = along - (0, 0, 2.3)  # a scanner's mast
    return list(poses)


class Costs:
    """Processor time by name."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def of(self, name: str) -> Iterator[None]:
        """Of what is done meanwhile."""
        start = time.thread_time()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.thread_time() - start


def main() -> None:
    """Measure, print a line of each step, and RESULT."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("world", type=Path)
    parser.add_argument("--pictures", type=int, default=150, help="of each camera")
    parser.add_argument("--bitrate", type=int, default=1_500_000, help="of each camera")
    asked = parser.parse_args()
    cv2.setNumThreads(1)
    scene = read_scene(asked.world)
    shapes = world((shape, tile.offset) for tile in scene.tiles for shape in tile.textured().values())
    eye, costs, keys = Eye(shapes, pinhole(640, 480, field=Mount().field)), Costs(), Keys(0.0)
    backend = encoders.find("pyav")
    coders = [Coder(i, keys, backend) for i in range(len(YAWS))]
    frames: list[Frame] = []
    watcher = Watcher(frames.append, lambda camera: None, lambda captured: 0.0, lambda *_: None, lambda: 0.1)
    watcher.learn(keys.told(0.0)[0])
    plan = Plan(asked.bitrate)
    decoder, read, quality, first = encoders.Decoder(), 0, [], 0
    eye.view(np.eye(4))  # compiled
    for i, pose in enumerate(street(asked.world, asked.pictures)):
        captured = round(i * 1e9 / FPS)
        for camera, yaw in enumerate(YAWS):
            with costs.of("render"):
                image = eye.view(pose @ mount(Mount(yaw=yaw)))
            timecode.mark(image, captured)
            with costs.of("encode and encrypt"):
                packets = coders[camera].code(Picture(image, captured), plan, captured / 1e9)
            first = max(first, sum(map(len, packets)) if i == 0 else 0)
            frames.clear()
            with costs.of("decrypt and order"):
                for packet in packets:
                    watcher.feed(packet, "lo")
            if camera == 0:
                with costs.of("decode"):
                    shown = decoder.decode(frames[0].data)
                assert shown is not None
                read += timecode.read(shown, captured, 640) is not None
                quality.append(cv2.PSNR(shown, image))
    pictures = asked.pictures * len(YAWS)
    each = {
        name: 1e3 * spent / (asked.pictures if name == "decode" else pictures) for name, spent in costs.seconds.items()
    }
    cores = {name: spent * FPS / asked.pictures for name, spent in costs.seconds.items()}
    for name, cost in each.items():
        print(f"{name:20} {cost:6.2f} ms a picture, {cores[name]:.2f} processors")
    sent = sum(coder.counts["bytes"] for coder in coders)
    result = {
        "ms_a_picture": {name: round(cost, 2) for name, cost in each.items()},
        "processors": round(sum(cores.values()), 2),
        "without_rendering": round(sum(cores.values()) - cores["render"], 2),
        "megabits": round(8e-6 * sent * FPS / asked.pictures, 2),
        "first_frame_bytes": first,
        "psnr_db": round(float(np.median(quality)), 1),
        "marks_read": read / asked.pictures,
    }
    print("RESULT", json.dumps(result))


if __name__ == "__main__":
    main()
