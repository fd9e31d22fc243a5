"""A rendered drive of 1.5 km, and `scan2sim slam` on it with both solvers."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any

from bench.measure import measure
from bench.paths import DATA
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.slam.trajectory.evaluate import Evaluation, evaluate, plot

EXIT_MOSTLY_EXTRAPOLATED = 9
"""Exit status if most of the path is extrapolated; its errors are reported anyway."""


def drive_of(out: Path, path: str, length: float) -> Path:
    """The rendered drive along a KITTI path, or a generated one; rendered if missing."""
    from scan2sim.data_samples import paths
    from scan2sim.data_samples.drive import generate_drive

    folder, file = out / f"drive_{path}", DATA / "kitti_gt_poses" / f"{path}.txt"
    if not (folder / "video.mp4").is_file():
        print(f"rendering {length:.0f} m of {path}: about a second per frame", flush=True)
        way = paths.kitti_path(file, length) if file.is_file() else paths.town_path(0, length)
        shutil.rmtree(folder, ignore_errors=True)
        generate_drive(folder, way, length=length, speed=15, fps=15, height=1024, bitrate=10e6, samples=4)
    return folder


def slam(drive: Path, out: Path, *options: object) -> tuple[Evaluation, dict[str, Any]]:
    """Run `scan2sim slam` on a drive; returns its errors and metrics."""
    shutil.rmtree(out, ignore_errors=True)
    command = [str(Path(sys.executable).parent / "scan2sim"), "slam", str(drive / "video.mp4"), "--out", str(out)]
    command += ["--gps", str(drive / "gps.csv"), "--gps-offset", "0", "--mask", str(drive / "mask.png")]
    measured = measure([*command, *map(str, options)])
    if measured.status not in (0, EXIT_MOSTLY_EXTRAPOLATED):
        sys.exit(f"scan2sim slam failed with exit status {measured.status}")
    found = evaluate(trajectory_io.read(out / "trajectory.csv"), trajectory_io.read(drive / "truth.csv"))
    plot(found, out / "plot.png")
    return found, json.loads((out / "slam.json").read_text(encoding="utf-8")) | {"peak_gb": measured.peak_gb}


def drive(out: Path, path: str, length: float, stretch: float) -> dict[str, float | None]:
    """Errors on the rendered drive; on its first `stretch` seconds with both solvers."""
    made = drive_of(out, path, length)
    adjacent = ("--backend", "adam", "--set", "track.gps_distances=adjacent")
    kinds: list[tuple[str, tuple[object, ...]]] = [("lm", ())]
    if stretch:
        kinds += [("lm_start", ("--until", stretch)), ("adam_start", ("--until", stretch, *adjacent))]
    found = {}
    for kind, options in kinds:
        result, facts = slam(made, out / f"slam_{path}_{kind}", *options)
        local = "-" if result.local_median is None else f"{result.local_median:.2f}"
        mean = f"global mean {result.global_mean:.2f} m ({result.drift_percent:.3f} %), local median 400 {local} m"
        cost = f"{facts['fps']:.1f} frames/s, {facts['unsure_share']:.1%} unsure, {facts['peak_gb']:.2f} GB"
        print(f"{path}, {result.length:.0f} m, {kind}: {mean}, {cost}", flush=True)
        found[kind] = (result, facts)
    whole, facts = found["lm"]
    return {
        "drift_percent": whole.drift_percent, "local400_m": whole.local_median, "fps": facts["fps"],
        "adam_drift_percent": found["adam_start"][0].drift_percent if stretch else None,
    }  # fmt: skip
