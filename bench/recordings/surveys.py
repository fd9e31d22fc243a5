"""Real drives as surveys: every one at hand, imported, cut into tiles of 12 m, and built as one world.

KITTI odometry 04, raw 0009 and raw 0013 (the folder that SCAN2SIM_REAL_DATA gives), at default settings.
`surveys_failed`: surveys without a world of all their tiles, of all `surveys`; `surveys_incomplete`: those whose world
is finished, but side products failed. An hour on two cores.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bench.maps.command import Missing, scan2sim

TILE_LENGTH_M = 12
INCOMPLETE = 10
"""Exit status of a finished world whose side products failed."""
DRIVES = {
    "odo04": ("kitti-odometry", "kitti_odo04_f00-24"),
    "raw0009": ("kitti-raw", "kitti_raw0009_f00-24"),
    "raw0013": ("kitti-raw", "kitti_raw0013_f62-83"),
}


def measure(out: Path) -> dict[str, Any]:
    """Figures of the part; what an earlier run finished isn't built again.

    Raises:
        Missing: a drive isn't there.
    """
    failed, incomplete = [], []
    for name, (layout, folder) in DRIVES.items():
        source = Path(os.environ.get("SCAN2SIM_REAL_DATA", "")) / folder
        if not source.is_dir():
            raise Missing(f"{folder} is not in the folder that SCAN2SIM_REAL_DATA gives")
        try:
            made = _survey(source, layout, out / name)
        except Missing as error:
            failed.append(name)
            print(f"surveys {name}: {error}", flush=True)
            continue
        failed += [name] * (not _is_whole(made, out / name / "survey" / "world"))
        incomplete += [name] * bool(made["failed"])
        states = ", ".join(f"{tile} {found['state']}" for tile, found in made["tiles"].items())
        print(f"surveys {name}: {states}; side products that failed: {', '.join(made['failed']) or 'none'}", flush=True)
    return {"surveys": len(DRIVES), "surveys_failed": len(failed), "surveys_incomplete": len(incomplete)}


def _survey(source: Path, layout: str, out: Path) -> dict[str, Any]:
    """Import a drive and build its survey; returns the survey's report."""
    if not (out / "tile" / "tile.toml").is_file():
        scan2sim(out / "import.log", "import", layout, source, "--out", out / "tile")
    words = ("survey", out / "tile", "--out", out / "survey", "--length", TILE_LENGTH_M, "--jobs", 2)
    scan2sim(out / "survey.log", *words, accepted=(0, INCOMPLETE))
    report: dict[str, Any] = json.loads((out / "survey" / "survey.json").read_text(encoding="utf-8"))
    return report


def _is_whole(report: Mapping[str, Any], world: Path) -> bool:
    """Whether a survey has a world with several tiles, all of them."""
    tiles = report["tiles"].values()
    return len(tiles) > 1 and all(t["state"] != "failed" for t in tiles) and any(world.glob("*.sdf"))
