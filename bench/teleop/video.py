"""Cost of a vehicle's video: CPU time of each stage from rendering a world's street to decoding at the station.

    python -m bench.teleop.video WORLD [--pictures 150] [--bitrate 1500000]

Four cameras of 640x480 drive along the world's recorded path at 30 frames/s, as fast as possible; packets are passed on
without a network. Times are CPU times, not wall-clock times.
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
from scan2sim.pipeline.io.worlds.scene import PATH_FILE, read_scene
from scan2sim.services.teleoperation import encoders, timecode
from scan2sim.services.teleoperation.cameras import CameraFrame, Mount
from scan2sim.services.teleoperation.sim.world_renderer import WorldRenderer, build_world
from scan2sim.services.teleoperation.video.capture import CameraEncoder
from scan2sim.services.teleoperation.video.jitter_buffer import Frame, VideoReceiver
from scan2sim.services.teleoperation.video.rate_control import EncodingPlan
from scan2sim.services.teleoperation.video.srtp_session import KeySchedule

FPS, YAWS = 30, (0, 90, -90, 180)


def street(folder: Path, count: int) -> list[F64]:
    """Vehicle poses (4, 4), evenly spaced along the path recorded with the first tile."""
    scene = read_scene(folder)
    with np.load(scene.tiles[0].extra_files[PATH_FILE]) as path:
        positions = path["positions"] + scene.tiles[0].offset
    at = np.linspace(0, len(positions) - 2, count)
    along = np.column_stack([np.interp(at, np.arange(len(positions)), positions[:, k]) for k in range(3)])
    heading = np.unwrap(np.arctan2(*np.gradient(cv2.blur(along[:, :2].copy(), (1, 15)), axis=0).T[::-1]))
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 0], poses[:, 0, 1] = np.cos(heading), -np.sin(heading)
    poses[:, 1, 0], poses[:, 1, 1] = np.sin(heading), np.cos(heading)
    poses[:, :3, 3] = along - (0, 0, 2.3)  # height of a scanner on its mast
    return list(poses)


class CpuTimes:
    """CPU time by name."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def of(self, name: str) -> Iterator[None]:
        """Add the CPU time of a block."""
        start = time.thread_time()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.thread_time() - start


def main() -> None:
    """Run the benchmark, print a line for each stage, and RESULT."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("world", type=Path)
    parser.add_argument("--pictures", type=int, default=150, help="frames per camera")
    parser.add_argument("--bitrate", type=int, default=1_500_000, help="bits per second and camera")
    given = parser.parse_args()
    cv2.setNumThreads(1)
    scene = read_scene(given.world)
    shapes = build_world((shape, tile.offset) for tile in scene.tiles for shape in tile.textured().values())
    renderer, cpu_times, keys = (
        WorldRenderer(shapes, pinhole(640, 480, field=Mount().field)),
        CpuTimes(),
        KeySchedule(0.0),
    )
    backend = encoders.find("pyav")
    coders = [CameraEncoder(i, keys, backend) for i in range(len(YAWS))]
    frames: list[Frame] = []
    receiver = VideoReceiver(frames.append, lambda camera: None, lambda captured: 0.0, lambda *_: None, lambda: 0.1)
    receiver.add_key(keys.announced(0.0)[0])
    plan = EncodingPlan(given.bitrate)
    decoder, read, quality, first = encoders.Decoder(), 0, [], 0
    renderer.view(np.eye(4))  # warm up: compile
    for i, pose in enumerate(street(given.world, given.pictures)):
        captured = round(i * 1e9 / FPS)
        for camera, yaw in enumerate(YAWS):
            with cpu_times.of("render"):
                image = renderer.view(pose @ Mount(yaw=yaw).pose())
            timecode.draw(image, captured)
            with cpu_times.of("encode and encrypt"):
                packets = coders[camera].encode(CameraFrame(image, captured), plan, captured / 1e9)
            first = max(first, sum(map(len, packets)) if i == 0 else 0)
            frames.clear()
            with cpu_times.of("decrypt and order"):
                for packet in packets:
                    receiver.feed(packet, "lo")
            if camera == 0:
                with cpu_times.of("decode"):
                    decoded = decoder.decode(frames[0].data)
                assert decoded is not None
                read += timecode.read(decoded, captured, 640) is not None
                quality.append(cv2.PSNR(decoded, image))
    pictures = given.pictures * len(YAWS)
    each = {
        name: 1e3 * spent / (given.pictures if name == "decode" else pictures)
        for name, spent in cpu_times.seconds.items()
    }
    cores = {name: spent * FPS / given.pictures for name, spent in cpu_times.seconds.items()}
    for name, cost in each.items():
        print(f"{name:20} {cost:6.2f} ms per frame, {cores[name]:.2f} cores")
    sent = sum(encoder.counts["bytes"] for encoder in coders)
    result = {
        "ms_a_picture": {name: round(cost, 2) for name, cost in each.items()},
        "processors": round(sum(cores.values()), 2),
        "without_rendering": round(sum(cores.values()) - cores["render"], 2),
        "megabits": round(8e-6 * sent * FPS / given.pictures, 2),
        "first_frame_bytes": first,
        "psnr_db": round(float(np.median(quality)), 1),
        "marks_read": read / given.pictures,
    }
    print("RESULT", json.dumps(result))


if __name__ == "__main__":
    main()
