"""Drives with INS poses: worlds of `import kitti-raw` alone, compared with worlds of sweep-matched poses.

KITTI raw 0009 and 0013 (the folder that SCAN2SIM_REAL_DATA gives). Matched poses are those of the data's ICP file
(0009), or of lidar odometry (0013).

`ins_gap_db`: the largest difference of PSNR against held-out photos (every 8th), of the world with matched poses minus
that of the import alone; after matching the brightness, over the pixels that both worlds show, as rendered by the
independent renderer of `bench.street`. The scores of each world alone are those of its report.
"""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from bench.maps.command import Missing, scan2sim
from bench.street import score
from bench.street.world import World, photos
from scan2sim.pipeline.importers.kitti_raw import read_drive

ICP = "T_velo0_velo_icp_frames_0-24.txt"
HOLD_OUT = 8
"""Every Nth photo is held out, from the (N / 2)th (frames 4, 12 and 20)."""
DRIVES = {"raw0009": "kitti_raw0009_f00-24", "raw0013": "kitti_raw0013_f62-83"}


def measure(out: Path) -> dict[str, Any]:
    """Figures of the part.

    Raises:
        Missing: a drive isn't there.
    """
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    result: dict[str, Any] = {}
    gaps = []
    for name, folder in DRIVES.items():
        source = Path(os.environ.get("SCAN2SIM_REAL_DATA", "")) / folder
        if not source.is_dir():
            raise Missing(f"{folder} is not in the folder that SCAN2SIM_REAL_DATA gives")
        poses = source / ICP
        if not poses.is_file():
            poses = _matched(source, out / f"{name}_odometry")
        worlds = {"alone": (), "matched": ("--poses", poses, "--pose-source", "given")}
        for kind, options in worlds.items():
            psnr, ssim = _world(source, out / f"{name}_{kind}", options)
            result |= {f"{name}_{kind}_db": round(psnr, 2), f"{name}_{kind}_ssim": round(ssim, 3)}
            print(f"ins {name} {kind:8} {psnr:.2f} dB, SSIM {ssim:.3f}", flush=True)
        alone, matched = _on_common_pixels([out / f"{name}_{kind}" for kind in worlds])
        gaps.append(matched - alone)
        print(f"ins {name} on common pixels: alone {alone:.2f}, matched {matched:.2f} dB", flush=True)
    return {"ins_gap_db": round(max(gaps), 2)} | result


def _on_common_pixels(worlds: list[Path]) -> list[float]:
    """Mean PSNR (dB) of each world over the held-out photos, where all worlds have a surface."""
    rendered = []
    for folder in worlds:
        world = World(folder / "run" / "world")
        views = photos(folder / "tile", folder / "run", world.origin)
        held = sorted(views)[HOLD_OUT // 2 :: HOLD_OUT]
        rendered.append([(views[frame].rgb, world.render(views[frame])) for frame in held])
    common = [np.all([rendering.hit for _, rendering in one], axis=0) for one in zip(*rendered, strict=True)]
    return [
        float(np.mean([score.similarity(photo, r.rgb, where)["psnr_db"] for (photo, r), where in pairs]))
        for pairs in (list(zip(one, common, strict=True)) for one in rendered)
    ]


def _world(source: Path, out: Path, options: tuple[object, ...]) -> tuple[float, float]:
    """PSNR (dB, after matching the brightness) and SSIM of a world against its held-out photos."""
    out.mkdir()
    scan2sim(out / "import.log", "import", "kitti-raw", source, "--out", out / "tile", *options)
    scan2sim(out / "run.log", "run", out / "tile", "--out", out / "run", "--hold-out", HOLD_OUT)
    texture = json.loads((out / "run" / "report.json").read_text(encoding="utf-8"))["texture"]
    return float(texture["psnr_gain_db"]), float(texture["ssim"])


def _matched(source: Path, out: Path) -> Path:
    """File of poses by lidar odometry, one per frame number."""
    drive = read_drive(source)
    out.mkdir()
    np.savetxt(out / "times.txt", drive.spans[:, 1] - drive.spans[0, 1], "%.6f")
    sweeps = next(iter(drive.sweeps.values())).parent
    scan2sim(
        out / "import.log", "import", "sweeps", sweeps, "--times", out / "times.txt", "--deskew", "kitti",
        "--min-range", 3.5, "--out", out / "tile",
    )  # fmt: skip
    rows = np.loadtxt(out / "tile-path" / "trajectory.kitti")
    numbers = list(drive.sweeps)
    table = np.tile(np.eye(4)[:3].ravel(), (numbers[-1] + 1, 1))
    table[numbers] = rows
    np.savetxt(out / "poses.txt", table)
    return out / "poses.txt"
