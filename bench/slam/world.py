"""World of a real street from SLAM poses, compared with the world from registered lidar poses.

`python -m bench.slam.world [--out bench-out/slam_world]`: the photos of a KITTI drive are processed by `scan2sim slam`
(scaled by its OXTS positions with 10 cm of noise), `import sweeps` assembles lidar and photos, `run` builds the world;
`import kitti-raw` with the registered poses gives the other world. Every fifth photo is held out in both.

Ends with `RESULT {json}`: mean distance between the two paths, distance of the cloud to its own mesh, and PSNR of the
held-out photos, for both.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from datetime import datetime
from pathlib import Path

import numpy as np

from bench.paths import DATA, ROOT
from bench.segmentation.run import scan2sim
from scan2sim.pipeline.geometry.similarity import umeyama
from scan2sim.pipeline.io.tile import read_tile

DRIVE = DATA / "kitti_raw0009_f00-24"


def seconds(file: Path, start: float) -> np.ndarray:
    """(T,) seconds after `start` (UNIX time), from a KITTI time stamp file."""
    return (
        np.array(
            [
                datetime.fromisoformat(line[:26]).timestamp()
                for line in file.read_text(encoding="utf-8").split("\n")
                if line
            ]
        )
        - start
    )


def prepare(out: Path, drive: Path) -> dict[str, Path]:
    """Write the inputs of `slam` and `import sweeps` for a KITTI drive: GPS, times, extrinsics."""
    sync = next(drive.glob("*_sync"))
    start = seconds(sync / "image_02" / "timestamps.txt", 0.0)[0]
    oxts = np.array(
        [
            [float(v) for v in f.read_text(encoding="utf-8").split()[:3]]
            for f in sorted((sync / "oxts/data").glob("*.txt"))
        ]
    )
    oxts[:, :2] += np.random.default_rng(0).normal(0, 0.1 / 111_000, (len(oxts), 2))
    times = seconds(sync / "oxts" / "timestamps.txt", start)[: len(oxts)]
    made = {name: out / f"{name}.txt" for name in ("photo_times", "sweep_times", "extrinsics")}
    made["gps"] = out / "gps.csv"
    table = np.column_stack([times, oxts])
    head = "time,latitude,longitude,altitude"
    np.savetxt(made["gps"], table, ["%.6f", "%.9f", "%.9f", "%.4f"], delimiter=",", header=head, comments="")
    photos, sweeps = sorted((sync / "image_02/data").iterdir()), sorted((sync / "velodyne_points/data").iterdir())
    np.savetxt(made["photo_times"], seconds(sync / "image_02" / "timestamps.txt", start)[: len(photos)], "%.6f")
    np.savetxt(made["sweep_times"], seconds(sync / "velodyne_points" / "timestamps.txt", start)[: len(sweeps)], "%.6f")
    numbers = {}
    for name in ("calib_cam_to_cam.txt", "calib_velo_to_cam.txt"):
        for line in (drive / name).read_text(encoding="utf-8").splitlines():
            key, _, values = line.partition(":")
            numbers[key] = values
    T = np.eye(4)
    T[:3, :3] = np.array(numbers["R"].split(), float).reshape(3, 3)  # of the second file: scanner to camera 0
    T[:3, 3] = np.array(numbers["T"].split(), float)
    rectify, P = np.eye(4), np.array(numbers["P_rect_02"].split(), float).reshape(3, 4)
    rectify[:3, :3] = np.array(numbers["R_rect_00"].split(), float).reshape(3, 3)
    T = rectify @ T
    T[:3, 3] += np.linalg.inv(P[:, :3]) @ P[:, 3]
    np.savetxt(made["extrinsics"], T[:3], "%.9f")
    return made


def main() -> None:
    """Build both worlds and compare them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "bench-out" / "slam_world")
    out: Path = parser.parse_args().out
    if not DRIVE.is_dir():
        sys.exit(f"{DRIVE} doesn't exist")
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    drive = next(p for p in DRIVE.iterdir() if p.is_dir())
    sync, made = next(drive.glob("*_sync")), prepare(out, drive)
    lens = ("--focal", 721.5377, "--centre", 609.5593, 172.854)
    photos = sync / "image_02" / "data"
    scan2sim("slam", photos, *lens, "--times", made["photo_times"], "--gps", made["gps"], "--gps-offset", 0,
             "--out", out / "slam")  # fmt: skip
    scan2sim("import", "sweeps", sync / "velodyne_points/data", out / "slam/trajectory.csv", "--out", out / "tile_slam",
             "--extrinsics", made["extrinsics"], "--times", made["sweep_times"], "--deskew", "kitti",
             "--photos", photos, "--photo-times", made["photo_times"], *lens, "--min-range", 3.2)  # fmt: skip
    poses = next(DRIVE.glob("T_velo0_velo_icp*"))
    scan2sim("import", "kitti-raw", drive, "--out", out / "tile_matched", "--poses", poses)
    result: dict[str, float] = {}
    paths = {}
    for kind in ("slam", "matched"):
        scan2sim("run", out / f"tile_{kind}", "--out", out / f"world_{kind}", "--hold-out", 5)
        report = json.loads((out / f"world_{kind}" / "report.json").read_text(encoding="utf-8"))
        for group, value in report["geometry"]["cloud_to_mesh_mean_m"].items():
            result[f"{kind}_{group}_m"] = value
        result[f"{kind}_psnr_db"] = report["texture"]["psnr_db"]
        tile = read_tile(out / f"tile_{kind}")
        assert tile.trajectory is not None
        paths[kind] = tile.trajectory.positions
    onto = umeyama(paths["slam"], paths["matched"], scaled=False)
    result["path_m"] = float(np.linalg.norm(onto.apply(paths["slam"]) - paths["matched"], axis=1).mean())
    for name, value in result.items():
        print(f"{name:<28}{value:.4f}")
    print("RESULT " + json.dumps({k: round(v, 4) for k, v in result.items()}))


if __name__ == "__main__":
    main()
