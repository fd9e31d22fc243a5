"""Path: positions of the scanner, for the orientation of normals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydantic import ConfigDict

from scan2sim.pipeline.core.step import Context, Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import Trajectory


class PathContext(Context):
    """The tile's trajectory, or else its camera positions.

    Attributes:
        positions: (x, y, z) local metres.
        times: GPS time in seconds of each position; None if unknown.
    """

    model_config = ConfigDict(allow_inf_nan=True)  # times are NaN if the file has none

    positions: tuple[tuple[float, float, float], ...]
    times: tuple[float, ...] | None = None


class PathParams(Params):
    """No settings."""

    context: PathContext


def path(inputs: Inputs, params: PathParams, out: Path, report: Report) -> Done:
    """Write the path as a `Trajectory`, ordered by time; times are NaN where unknown."""
    positions = np.array(params.context.positions, np.float64)
    times = np.full(len(positions), np.nan) if params.context.times is None else np.array(params.context.times)
    order = np.argsort(times, kind="stable")
    Trajectory(times[order], positions[order]).save(out / "path.npz")
    length = float(np.linalg.norm(np.diff(positions[order], axis=0), axis=1).sum()) if params.context.times else None
    return Done({"path": out / "path.npz"}, {"positions": len(positions), "length_m": length})


PATH = Step("path", 1, path, PathParams)
