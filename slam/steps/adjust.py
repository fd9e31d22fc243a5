"""Step `adjust`: global bundle adjustment of all keyframes and points of a video."""

from __future__ import annotations

from pathlib import Path

from scan2sim.pipeline.core.optional_deps import require
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.slam.global_map.global_adjustment import adjust
from scan2sim.slam.global_map.map_file import MapCheckpoint


def adjust_all(inputs: Inputs, params: Params, out: Path, report: Report) -> Done:
    """Global bundle adjustment of all keyframes and points of `map`, kept if held-out features fit it better."""
    checkpoint = MapCheckpoint.read(inputs["map"])
    metrics = adjust(checkpoint)
    held_out = metrics["held_out_features"]
    rejected = f"the adjusted path doesn't fit {held_out} held-out features better: odometry's path is kept"
    warnings = [] if metrics["adjustment_kept"] else [rejected]
    return Done({"map": checkpoint.write(out / "map.npz")}, metrics, warnings)


def can_adjust(params: Params) -> None:
    """Raise an UnavailableError where pycolmap isn't installed."""
    require("--adjust", "pycolmap")


ADJUST = Step("adjust", 5, adjust_all, Params, check=can_adjust)
