"""The detector trained by `toolbox train --drives` on two real drives, on a third one (part `drives`).

`python -m bench.toolboxes.drives [--minutes 35] [--out DIR]` imports KITTI raw 0013 and odometry 04 (the folder that
SCAN2SIM_REAL_DATA gives), trains on the vehicles that the lidar found in their photos, and counts the vehicles of
raw 0009 that it detects, by KITTI's labels: drives_vehicle_recall is the recall at the lowest score from which the
precision is at least .8. An earlier training in DIR is used. What it learns from may not be redistributed, so neither
may the network.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from bench.paths import DATA
from bench.toolboxes.detect import RAW_0009, vehicles
from scan2sim.services.toolboxes.detector.evaluate import MIN_SCORE, at_precision
from scan2sim.services.toolboxes.tasks import detect

MINUTES = 35.0
RAW_0013, ODO_04 = "kitti_raw0013_f62-83", "kitti_odo04_f00-24"
POSES = "T_velo0_velo_icp_frames_0-24.txt"
IMPORTS = {
    "raw0013": ("kitti-raw", str(DATA / RAW_0013)),
    "odo04": ("kitti-odometry", str(DATA / ODO_04)),
    "raw0009": ("kitti-raw", str(DATA / RAW_0009), "--poses", str(DATA / RAW_0009 / POSES)),
}
"""Arguments of `scan2sim import` by drive; the last one is held out."""


def drives(out: Path, minutes: float = MINUTES) -> dict[str, Any] | None:
    """Recall of vehicles in a drive that the detector was not trained on; None without the data."""
    missing = [name for name in (RAW_0013, ODO_04, RAW_0009) if not (DATA / name).is_dir()]
    if missing:
        print(f"drives: skipped, {DATA} has no {', '.join(missing)}")
        return None
    for name, arguments in IMPORTS.items():
        if not (out / name / "tile.toml").is_file():
            _scan2sim("import", *arguments, "--max-range", "80", "--out", str(out / name))
    weights = out / "trained" / "vehicles.onnx"
    if not weights.is_file():
        *learned, held_out = (str(out / name) for name in IMPORTS)
        chosen = [argument for name in learned for argument in ("--drives", name)]
        _scan2sim(
            "toolbox", "train", *chosen, "--held-out", held_out, "--minutes", str(minutes), "--out", str(weights.parent)
        )
    figures = at_precision(*vehicles(detect.load(detect.Params(weights=weights, threshold=MIN_SCORE))))
    print(f"{weights}: {figures}")
    return {
        "drives_vehicle_recall": round(figures.recall, 3),
        "drives_vehicle_precision": round(figures.precision, 3),
        "drives_threshold": round(figures.threshold, 3),
    }


def _scan2sim(*arguments: str) -> None:
    subprocess.run([sys.executable, "-m", "scan2sim.flows.cli", *arguments], check=True)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=MINUTES, help="time limit of the training")
    parser.add_argument("--out", type=Path, default=Path("bench-out/toolboxes/drives"))
    given = parser.parse_args()
    print("RESULT", json.dumps(drives(given.out, given.minutes)))


if __name__ == "__main__":
    main()
