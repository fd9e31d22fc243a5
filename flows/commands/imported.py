"""What an import reports when its tile is finished: warnings, and the results of its checks."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from scan2sim.pipeline.io import trajectory_check
from scan2sim.pipeline.plausibility.check import check_tile
from scan2sim.pipeline.pose_check.check import read_check


def all_warnings(tile: Path, warnings: Iterable[str]) -> list[str]:
    """Warnings of the import of a `tile.toml`, each once, and what is implausible about the tile."""
    return list(dict.fromkeys((*warnings, *check_tile(tile))))


def summaries(tile: Path) -> list[str]:
    """A line for each check of poses whose result is beside a `tile.toml`: of the trajectory, of the photos."""
    lines = []
    check, photos = trajectory_check.read(tile.parent), read_check(tile.parent)
    if check is not None:
        summary = str(check.get("summary"))
        lines.append(summary[:1].upper() + summary[1:])
    if photos is not None:
        lines.append(f"Photos: {photos.get('summary')}")
    return lines
