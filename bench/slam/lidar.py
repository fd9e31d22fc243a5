"""Lidar, camera and GPS, each alone and fused in one graph: error of the scanner's path for each.

`python -m bench.slam.lidar [--out bench-out/slam_lidar] [--turn FRAMES]`, over

- KITTI odometry 04: 25 real sweeps and photos, true poses, a simulated receiver (`data_samples.gps`);
- the rendered turn of `data_samples.turn` (FRAMES, if it is rendered already), with sweeps of the same town;
- ten simulated drives of 400 m (`simulated`), each with a tunnel of 60 m for the lidar, a dark stretch of 50 m for the
  camera, whose scale drifts, and GPS with outliers and a jump.

Errors are RMS distances in metres after a rigid alignment, for the camera (without scale) after a similarity.
Ends with `RESULT {json}`.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.paths import ROOT
from bench.segmentation.run import scan2sim
from scan2sim.data_samples import paths, turn
from scan2sim.data_samples.gps import receiver
from scan2sim.data_samples.panorama import Panorama
from scan2sim.data_samples.town import build
from scan2sim.data_samples.traffic import Traffic
from scan2sim.pipeline.camera.models import pixel_rays
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import F64, Camera, Trajectory
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.pipeline.io.calibration import photo_extrinsics, read_extrinsics
from scan2sim.slam.geometry import inverse
from scan2sim.slam.steps.fuse import FuseParams, fuse_path
from scan2sim.slam.steps.lidar import LidarParams, lidar
from tests.fakes.lidar_drive import simulated
from tests.fakes.slam_drive import ate

KITTI = ROOT.parent / "shared" / "data" / "kitti_odo04_f00-24"
SENSORS = ("lidar", "visual", "gps", "fused")
T_CAMERA_SCANNER = np.array([[0.0, -1, 0, 0], [0, 0, -1, -0.3], [1, 0, 0, 0], [0, 0, 0, 1]])
"""Extrinsics in the turn: the scanner is 30 cm above the camera."""
SWEEP_ROWS, MIN_ELEVATION_DEG, MAX_ELEVATION_DEG = 360, -25.0, 15.0
"""Rows of half a degree in the turn's sweeps, and their range of elevations."""
RANGE_NOISE_M = 0.02
"""Standard deviation of the ranges."""


@dataclass(frozen=True)
class Recorded:
    """A drive on disk.

    Attributes:
        sweeps, photos: folders.
        truth: (T, 4, 4) scanner poses at `times` (T,), at which each sweep and each photo was taken.
        focal, centre: intrinsics of the photos, pixels.
        extrinsics, clock, gps: files with T_camera_scanner, the times and the receiver's fixes.
    """

    sweeps: Path
    photos: Path
    truth: F64
    times: F64
    focal: float
    centre: tuple[float, float]
    extrinsics: Path
    clock: Path
    gps: Path

    def measure(self, out: Path) -> dict[str, float]:
        """ATE of each sensor alone, and of all fused."""
        scan2sim("slam", self.photos, "--focal", self.focal, "--centre", *self.centre, "--times", self.clock,
                 "--out", out / "slam")  # fmt: skip
        for name in ("lidar", "fused"):
            (out / name).mkdir(parents=True, exist_ok=True)
        given = {"sweeps": self.sweeps, "times": self.clock}
        matched = lidar(given, LidarParams(), out / "lidar", silent, out / "checkpoint").files["matched"]
        alone = fuse_path({**given, "matched": matched}, FuseParams(), out / "lidar", silent)
        poses = out / "slam" / "trajectory.csv"
        sources = {"matched": matched, "poses": poses, "extrinsics": self.extrinsics, "gps": self.gps}
        fused = fuse_path(given | sources, FuseParams(), out / "fused", silent)
        print(f"{out.name}: {fused.metrics['summary']}; unsure {fused.metrics['unsure_share']}")
        truth = self.truth[:, :3, 3]
        fixes = np.loadtxt(self.gps, delimiter=",", skiprows=1)
        there = np.column_stack([np.interp(self.times, fixes[:, 0], fixes[:, k]) for k in (1, 2, 3)])
        camera = trajectory_io.read(poses)
        beside = (self.truth @ inverse(read_extrinsics(self.extrinsics)))[:, :3, 3]
        return {
            "lidar": ate(trajectory_io.read(alone.files["trajectory"]).positions, truth, scaled=False),
            "visual": ate(camera.positions, beside),
            "gps": ate(there, truth, scaled=False),
            "fused": ate(trajectory_io.read(fused.files["trajectory"]).positions, truth, scaled=False),
        }


def write_fixes(truth: F64, times: F64, out: Path) -> Path:
    """Write the fixes of a simulated consumer receiver, five per second, for poses (T, 4, 4) with z up."""
    way = Trajectory(np.append(times, times[-1] + 0.3), np.concatenate([truth, truth[-1:]])[:, :3, 3])
    when, positions = receiver(way, rate=5.0)
    np.savetxt(out, np.column_stack([when, positions]), "%.4f", delimiter=",", header="time,x,y,z", comments="")
    return out


def kitti(out: Path) -> Recorded:
    """KITTI odometry 04: the scanner's true poses are those of camera 0, transformed with `Tr`."""
    out.mkdir(parents=True, exist_ok=True)
    calib, photos = KITTI / "calib.txt", KITTI / "image_2"
    T = read_extrinsics(calib)
    camera = np.tile(np.eye(4), (25, 1, 1))
    camera[:, :3] = np.loadtxt(KITTI / "poses.txt")[:25].reshape(-1, 3, 4)
    truth = inverse(T) @ camera @ T
    times = np.loadtxt(KITTI / "times.txt")[:25]
    beside = photo_extrinsics(calib, photos)
    assert beside is not None
    np.savetxt(out / "extrinsics.txt", beside[:3], "%.9f")
    np.savetxt(out / "times.txt", times, "%.6f")
    line = next(line for line in calib.read_text(encoding="utf-8").splitlines() if line.startswith("P2:"))
    P = [float(value) for value in line.split()[1:]]
    return Recorded(
        KITTI / "velodyne", photos, truth, times, P[0], (P[2], P[6]), out / "extrinsics.txt", out / "times.txt",
        write_fixes(truth, times, out / "gps.csv"),
    )  # fmt: skip


def turn_drive(out: Path, frames: Path | None) -> Recorded:
    """The rendered turn, with instantaneous sweeps of the town around it."""
    frames = turn.generate_turn(out / "frames") if frames is None else frames
    path = paths.town_path(0, turn.PATH_LENGTH_M)
    whole = paths.drive(path, turn.SPEED_M_S, turn.FPS, still=0.0, seed=0)
    driven = turn.filmed(whole)
    town = Panorama(build(path, 0), Traffic(path, whole, 0), SWEEP_ROWS, 0)
    rays = pixel_rays(Camera("equirectangular", 2 * SWEEP_ROWS, SWEEP_ROWS)).reshape(-1, 3).astype(np.float64)
    height = np.degrees(np.arcsin(-rays[:, 1]))
    beam = (height > MIN_ELEVATION_DEG) & (height < MAX_ELEVATION_DEG)
    truth, rng = driven.poses @ T_CAMERA_SCANNER, np.random.default_rng(0)
    (out / "sweeps").mkdir(parents=True, exist_ok=True)
    for i, (pose, time) in enumerate(zip(truth, driven.times, strict=True)):
        looking = pose.copy()
        looking[:3, :3] = pose[:3, :3] @ T_CAMERA_SCANNER[:3, :3].T
        far = town.render(looking, float(time)).depth.ravel()
        hit = beam & (far < 80) & (far > 1)
        xyz = rays[hit] * (far[hit] + rng.normal(0, RANGE_NOISE_M, int(hit.sum())))[:, None] @ T_CAMERA_SCANNER[:3, :3]
        np.column_stack([xyz, np.full(len(xyz), 0.5)]).astype(np.float32).tofile(out / "sweeps" / f"{i:06d}.bin")
    np.savetxt(out / "extrinsics.txt", T_CAMERA_SCANNER[:3], "%.9f")
    times = driven.times - driven.times[0]
    np.savetxt(out / "times.txt", times, "%.6f")
    P = [float(value) for value in (frames / "calib.txt").read_text(encoding="utf-8").split()]
    return Recorded(
        out / "sweeps", frames / "image_l", truth, times, P[0], (P[2], P[6]), out / "extrinsics.txt",
        out / "times.txt", write_fixes(truth, times, out / "gps.csv"),
    )  # fmt: skip


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "bench-out" / "slam_lidar")
    parser.add_argument("--turn", type=Path, help="output folder of `python -m scan2sim.data_samples.turn`")
    a = parser.parse_args()
    rows: dict[str, Mapping[str, float]] = {}
    if KITTI.is_dir():
        rows["kitti"] = kitti(a.out / "kitti").measure(a.out / "kitti")
    drives = [simulated(seed).measure() for seed in range(10)]
    rows["simulated"] = {name: float(np.mean([one[name] for one in drives])) for name in SENSORS}
    rows["turn"] = turn_drive(a.out / "turn", a.turn).measure(a.out / "turn")
    print(f"{'ATE, m':<12}" + "".join(f"{name:>10}" for name in SENSORS))
    for drive, row in rows.items():
        print(f"{drive:<12}" + "".join(f"{row[name]:>10.3f}" for name in SENSORS))
    prefix = {"kitti": "", "turn": "turn_", "simulated": "simulated_"}
    figures = {f"{prefix[d]}{name}_ate_m": round(row[name], 4) for d, row in rows.items() for name in SENSORS}
    print("RESULT " + json.dumps(figures))


if __name__ == "__main__":
    main()
