"""Rendered drives with difficult conditions: each alone, and all together."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from bench.slam.drive import slam
from scan2sim.data_samples import paths
from scan2sim.data_samples.drive import DriveConditions, generate_drive
from scan2sim.pipeline.core.types import F64

LENGTH, HEIGHT, FPS = 100.0, 512, 15.0
ALL = DriveConditions(hills=0.08, exposure=0.01, rolling_shutter=0.016, lens_offset=0.03, glare=True)
NONE = DriveConditions()
DRIVES: dict[str, tuple[bool, DriveConditions]] = {
    "none": (False, NONE),
    "hills, 8 %": (False, replace(NONE, hills=ALL.hills)),
    "turns of 90 degrees every 55 m": (True, NONE),
    "motion blur, 10 ms": (False, replace(NONE, exposure=ALL.exposure)),
    "rolling shutter, 16 ms": (False, replace(NONE, rolling_shutter=ALL.rolling_shutter)),
    "lenses 6 cm apart": (False, replace(NONE, lens_offset=ALL.lens_offset)),
    "glare": (False, replace(NONE, glare=True)),
    "all": (True, ALL),
}
"""Whether the path has sharp turns, and further difficulties."""


def hard(out: Path) -> dict[str, float | None]:
    """Drift for each difficulty, without and with estimated rolling shutter and lens offset; returns that of all."""
    print("| | drift % | estimated: drift % | readout, ms (truth) | lens offset, cm (truth) | unsure |")
    for name, (turns, conditions) in DRIVES.items():
        way = paths.zigzag_path(LENGTH) if turns else paths.town_path(0, LENGTH)
        folder = render_drive(out / f"hard_{list(DRIVES).index(name)}", way, conditions)
        plain, _ = slam(folder, out / f"slam_{folder.name}")
        both = ("--set", "track.rolling_shutter=true", "--set", "track.lens_offset=true")
        found, metrics = slam(folder, out / f"slam_{folder.name}_shared", *both)
        readout, offset = 1e3 * metrics["readout"], 1e2 * metrics["lens_offset"]
        truth = 1e3 * conditions.rolling_shutter, 1e2 * conditions.lens_offset
        print(
            f"| {name} | {plain.drift_percent:.3f} | {found.drift_percent:.3f} | {readout:.1f} ({truth[0]:.0f}) "
            f"| {offset:.2f} ({truth[1]:.0f}) | {metrics['unsure_share']:.1%} |",
            flush=True,
        )
    return {"hard_drift_percent": found.drift_percent}


def render_drive(folder: Path, way: F64, conditions: DriveConditions) -> Path:
    """Folder of the drive, rendered if missing."""
    if not (folder / "video.mp4").is_file():
        generate_drive(
            folder, way, length=LENGTH, fps=FPS, height=HEIGHT, bitrate=5e6, samples=1 if conditions.exposure else 2,
            conditions=conditions, overwrite=True,
        )  # fmt: skip
    return folder
