"""Photos without poses: `scan2sim import images` with the cloud of a drive, compared with its ground truth.

KITTI odometry 04 (the folder that SCAN2SIM_REAL_DATA gives): every second photo, the cloud of its sweeps, and a
GPS track of the true positions with a constant error of 1.5 m per axis (standard deviation) and .3 m per fix.
`photos_pose_m` and `photos_turn_deg`: RMS error of position, and mean error of rotation, of the photos in the tile;
`photos_mistakes`: mistakes that the check of the poses names.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from bench.maps.command import Missing, scan2sim
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.pose_check.check import find_mistake

DRIVE = "kitti_odo04_f00-24"
EVERY = 2
LENS = ("--focal", 707.0912, "--centre", 601.8873, 183.1104)
BIAS_M, NOISE_M = 1.5, 0.3


def measure(out: Path) -> dict[str, Any]:
    """Figures of the part.

    Raises:
        Missing: the drive isn't there, or an import failed.
    """
    source = Path(os.environ.get("SCAN2SIM_REAL_DATA", "")) / DRIVE
    if not source.is_dir():
        raise Missing(f"{DRIVE} is not in the folder that SCAN2SIM_REAL_DATA gives")
    shutil.rmtree(out, ignore_errors=True)
    photos = out / "photos"
    photos.mkdir(parents=True)
    scan2sim(
        out / "truth.log", "import", "kitti-odometry", source, "--out", out / "truth", "--pose-source", "given"
    )  # fmt: skip
    truth = read_tile(out / "truth")
    views = truth.views[::EVERY]
    for view in views:
        (photos / view.photo.name).symlink_to(view.photo.resolve())
    random = np.random.default_rng(1)
    xyz = truth.frame.to_crs(np.array([view.centre for view in views]))
    xyz = xyz + random.normal(size=3) * BIAS_M + random.normal(size=xyz.shape) * NOISE_M
    times = [view.time if view.time is not None else 0.1 * EVERY * i for i, view in enumerate(views)]
    rows = [f"{time},{x:.3f},{y:.3f},{z:.3f}\n" for time, (x, y, z) in zip(times, xyz, strict=True)]
    (out / "gps.csv").write_text("time,x,y,z\n" + "".join(rows), encoding="utf-8")
    (out / "times.txt").write_text("".join(f"{time}\n" for time in times), encoding="utf-8")
    run = scan2sim(
        out / "import.log", "import", "images", photos, "--cloud", truth.clouds[0], "--crs", "local", "--gps",
        out / "gps.csv", "--times", out / "times.txt", *LENS, "--out", out / "tile",
    )  # fmt: skip
    found = read_tile(out / "tile")
    known = {view.photo.name: view for view in views}
    offsets, turns = [], []
    for view in found.views:
        true = known[view.photo.name]
        offsets.append(found.frame.to_crs(view.centre) - truth.frame.to_crs(true.centre))
        turn = view.T_world_cam[:3, :3].T @ true.T_world_cam[:3, :3]
        turns.append(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))))
    pose = float(np.sqrt(np.square(offsets).sum(axis=1).mean()))
    mistake = find_mistake(found)
    print(
        f"photos {DRIVE}: {len(found.views)} of {len(views)} photos, position {pose:.3f} m, rotation "
        f"{np.mean(turns):.2f} degrees, {run.seconds:.0f} s; {mistake or 'no mistake named'}",
        flush=True,
    )
    return {
        "photos_pose_m": round(pose, 3), "photos_turn_deg": round(float(np.mean(turns)), 3),
        "photos_mistakes": int(mistake is not None),
    }  # fmt: skip
