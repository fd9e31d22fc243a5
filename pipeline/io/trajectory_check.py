"""Result of checking a scanner's path against its data: files beside the `tile.toml` of an import.

`trajectory_check.json` has the source of the poses, how well surfaces agreed before and after a correction, and where
they still disagree; `trajectory_correction.csv` the correction, if there is one: time, x, y, z (m) and the rotation
vector rx, ry, rz (rad), which are added to the given poses in world axes.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64

CHECK, CORRECTION = "trajectory_check.json", "trajectory_correction.csv"
COLUMNS = "time,x,y,z,rx,ry,rz"


def write(folder: Path, check: dict[str, Any], correction: F64 | None) -> Path:
    """Write the files of a check, and of a correction (N, 7) if there is one; returns the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / CHECK).write_text(json.dumps(check, indent=1) + "\n", encoding="utf-8")
    if correction is not None:
        formats = ["%.6f", *3 * ["%.4f"], *3 * ["%.6f"]]
        np.savetxt(folder / CORRECTION, correction, formats, ",", header=COLUMNS, comments="")
    return folder


def copy(folder: Path, tile: Path) -> None:
    """Copy the files of a check into the folder of a tile."""
    for name in (CHECK, CORRECTION):
        if (folder / name).is_file():
            shutil.copyfile(folder / name, tile / name)


def read(tile: Path) -> dict[str, Any] | None:
    """Content of a tile's check; None if it has none, or a damaged one."""
    try:
        content = json.loads((tile / CHECK).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return content if isinstance(content, dict) else None


def read_correction(folder: Path) -> F64 | None:
    """Correction (N, 7) in a folder; None if it has none.

    Raises:
        InputError: the file is damaged.
    """
    path = folder / CORRECTION
    if not path.is_file():
        return None
    try:
        table = np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)
        if (
            table.shape[1] != len(COLUMNS.split(","))
            or not np.isfinite(table).all()
            or (np.diff(table[:, 0]) < 0).any()
        ):
            raise ValueError(f"columns must be {COLUMNS}, in order of time")
    except ValueError as error:
        raise InputError(path, f"is not a correction of a path ({error})", "Import the recording again") from None
    return table
