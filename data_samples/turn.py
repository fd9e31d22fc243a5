"""Render a turn at a junction with a perspective camera, in KITTI's odometry format: images, poses, calibration.

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

PATH_LENGTH_M, FILM_START_M, FILM_LENGTH_M = 600.0, 74.0, 52.0
"""Length of the town's path, and start and length of the rendered part, in which the path turns by 98 degrees."""
FPS = 6.5
"""About a metre between frames, as in KITTI's turns."""
SPEED_M_S = 10.0  # m/s on straights


def camera_of(height: int) -> Camera:
    """Camera with KITTI's field of view, and the angular resolution of a panorama of `height` rows at its centre."""
    focal = height / np.pi
    width, rows = round(1.755 * focal / 2) * 2, round(0.532 * focal / 2) * 2
    return Camera("pinhole", width, rows, focal, focal, (width - 1) / 2, (rows - 1) / 2)


def filmed(whole: Trajectory) -> Trajectory:
    """Poses of a drive that are rendered."""
    travelled = paths.chainage(whole.positions[:, :2])
    rendered = (travelled >= FILM_START_M) & (travelled <= FILM_START_M + FILM_LENGTH_M)
    assert whole.rotations is not None
    return Trajectory(whole.times[rendered], whole.positions[rendered], whole.rotations[rendered])


def generate_turn(out: Path, *, height: int = 2048, seed: int = 0, report: Report = silent) -> Path:
    """Render a turn into the folder `out`, and return it; see the module's description.

    Args:
        out: output folder.
        height: rows of the panoramas from which the images are resampled.
        seed: seed of town, traffic and light.
        report: receives progress.
    """
    import cv2

    path, camera = paths.town_path(seed, PATH_LENGTH_M), camera_of(height)
    whole = paths.drive(path, SPEED_M_S, FPS, still=0.0, seed=seed)
    driven = filmed(whole)
    town = Panorama(build(path, seed), Traffic(path, whole, seed), height, seed)
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
    parser.add_argument("out", type=Path, help="output folder")
    parser.add_argument("--height", type=int, default=2048, help="rows of the panoramas to resample (default: 2048)")
    parser.add_argument("--seed", type=int, default=0, help="seed of town, traffic and light (default: 0)")
    a = parser.parse_args()
    generate_turn(
        a.out, height=a.height, seed=a.seed, report=lambda share, text="": print(f"{100 * share:.0f} %", text)
    )


if __name__ == "__main__":
    main()
