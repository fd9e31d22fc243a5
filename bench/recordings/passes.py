"""Two passes of a synthetic street whose INS drifts: how well their surfaces agree after `import sweeps`.

`passes_gap_cm`: largest distance, of all places that both passes scanned, between the surfaces of one and of the other
(root mean square over the points of a sweep within 15 m); `passes_offset_cm`: distance of the mean position from the
truth, which the INS's error (`passes_ins_offset_cm`) bounds.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from bench.maps.command import scan2sim
from scan2sim.pipeline.io.tile import read_tile
from tests.fakes.two_passes import passes


def measure(out: Path) -> dict[str, Any]:
    """Figures of the part."""
    shutil.rmtree(out, ignore_errors=True)
    drive = passes()
    drive.write(out, drive.ins)
    scan2sim(out / "import.log", "import", "sweeps", out / "sweeps", out / "poses.csv", "--out", out / "tile")
    tile = read_tile(out / "tile")
    assert tile.trajectory is not None
    poses = tile.trajectory.poses.copy()
    poses[:, :3, 3] += tile.frame.origin
    before, after = drive.gap(drive.ins), drive.gap(poses)
    for name, gap in (("INS", before), ("imported", after)):
        print(f"passes {name:10} median {100 * np.median(gap):.1f} cm, largest {100 * gap.max():.1f} cm", flush=True)
    return {
        "passes_gap_cm": round(100 * float(after.max()), 2),
        "passes_offset_cm": round(100 * drive.offset(poses), 1),
        "passes_ins_offset_cm": round(100 * drive.offset(drive.ins), 1),
    }
