"""Film a turn at a junction with a perspective camera, as KITTI's odometry comes: pictures, poses, calibration.

`python -m scan2sim.data_samples.turn OUT` writes `image_l/000000.png` and so on, `poses.txt`, `calib.txt`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from scan2sim.data_samples import paths
from scan2sim.data_samples.panorama import Panorama
from scan2sim.data_samples.town import build
from scan2sim.data_samples.traffic import Traffic
from scan2sim.pipeline.camera.models import pixel_rays, project
from scan2sim.pipeline.core.step import Report, silent
from scan2sim.pipeline.core.types import Camera, Trajectory

WAY, TOWARDS, LONG = 600.0, 74.0, 52.0
"""Metres: of the town's path, from its start to the film's, and of the film; in it, the path turns by 98 degrees."""
FPS = 6.5
"""Frames a second: about a metre from one to the next, as in KITTI's turns."""
SPEED = 10.0  # m/s on straights


def camera_of(height: int) -> Camera:
    """KITTI's angle of view, as fine as a panorama of `height` rows in its middle."""
    focal = height / np.pi
    width, rows = round(1.755 * focal / 2) * 2, round(0.532 * focal / 2) * 2
    return Camera("pinhole", width, rows, focal, focal, (width - 1) / 2, (rows - 1) / 2)


def filmed(whole: Trajectory) -> Trajectory:
    """The poses of a drive that are filmed."""
    way = paths.chainage(whole.positions[:, :2])
    there = (way >= TOWARDS) & (way <= TOWARDS + LONG)
    assert whole.rotations is not None
    return Trajectory(whole.times[there], whole.positions[there], whole.rotations[there])


def generate_turn(out: Path, *, height: int = 2048, seed: int = 0, report: Report = silent) -> Path:
    """Write the folder `out`, as the module says, and return it.

    Args:
        height: rows of the panoramas that the pictures are cut from.
        seed: of town, traffic and light.
    """
    import cv2

    way, camera = paths.town_path(seed, WAY), camera_of(height)
    whole = paths.drive(way, SPEED, FPS, still=0.0, seed=seed)
    driven = filmed(whole)
    town = Panorama(build(way, seed), Traffic(way, whole, seed), height, seed)
    uv, _ = project(Camera("equirectangular", 2 * height, height), pixel_rays(camera).reshape(-1, 3).astype(np.float64))
    maps = uv.reshape(camera.height, camera.width, 2).transpose(2, 0, 1).astype(np.float32)
    (out / "image_l").mkdir(parents=True, exist_ok=True)
    for i, (pose, time) in enumerate(zip(driven.poses, driven.times, strict=True)):
        report(i / len(driven), f"frame {i + 1} of {len(driven)}")
        rgb = cv2.remap(town.render(pose, float(time)).rgb, *maps, cv2.INTER_CUBIC)
        cv2.imwrite(str(out / "image_l" / f"{i:06d}.png"), cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY))
    from_first = np.linalg.inv(driven.poses[0]) @ driven.poses
    np.savetxt(out / "poses.txt", from_first[:, :3].reshape(-1, 12))
    P = [camera.fx, 0, camera.cx, 0, 0, camera.fy, camera.cy, 0, 0, 0, 1, 0]
    (out / "calib.txt").write_text(" ".join(map(str, P)) + "\n", encoding="utf-8")
    return out


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m scan2sim.data_samples.turn", description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--height", type=int, default=2048, help="rows of the panoramas that pictures are cut from")
    parser.add_argument("--seed", type=int, default=0)
    a = parser.parse_args()
    generate_turn(
        a.out, height=a.height, seed=a.seed, report=lambda share, text="": print(f"{100 * share:.0f} %", text)
    )


if __name__ == "__main__":
    main()
