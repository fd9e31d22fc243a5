"""False alarms: findings about plausibility in recordings that are right."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from bench.paths import ROOT
from bench.street.run import STREETS, scan2sim
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.plausibility.check import find_implausible

REAL_DATA = "SCAN2SIM_REAL_DATA"
WRONG = ("dddmr.pcd",)
"""Real files whose findings are true: y is up."""


def false_alarms(folder: Path) -> int | None:
    """Number of findings in the sample and the real recordings; None without recordings."""
    data = os.environ.get(REAL_DATA)
    if data is None:
        return None
    count = 0
    for tile in _tiles(Path(data), folder):
        for text in find_implausible(read_tile(tile)):
            print(f"false alarm    {tile.name}: {text}", flush=True)
            count += 1
    return count


def _tiles(data: Path, folder: Path) -> Iterator[Path]:
    yield ROOT / "data_samples" / "tile"
    for path in sorted([*(data / "las").glob("*.la[sz]"), *(data / "slam_maps").glob("*.pcd")]):
        if path.name not in WRONG:
            local = ("--crs", "local") if path.suffix == ".pcd" or path.name == "sample_c.las" else ()
            scan2sim("import", "clouds", path, "--out", folder / path.stem, *local)
            yield folder / path.stem
    for name, street in STREETS.items():
        scan2sim("import", *street.importing, "--out", folder / name)
        yield folder / name
