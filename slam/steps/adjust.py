"""Adjust: all keyframes and points of a video at once, afterwards."""

from __future__ import annotations

from pathlib import Path

from scan2sim.pipeline.core.optional_deps import need
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.slam.mapping.global_adjustment import adjust
from scan2sim.slam.mapping.map_file import Mapped


def adjust_all(inputs: Inputs, params: Params, out: Path, report: Report) -> Done:
    """Move keyframes and points of `mapped` to where all observations fit best."""
    mapped = Mapped.read(inputs["mapped"])
    facts = adjust(mapped)
    stays = f"{facts['witnesses']} features that had no say in it fit the adjusted path no better: odometry's is kept"
    return Done({"mapped": mapped.write(out / "mapped.npz")}, facts, [] if facts["adjustment_kept"] else [stays])


def can_adjust(params: Params) -> None:
    """Raise an UnavailableError where pycolmap isn't installed."""
    need("--adjust", "pycolmap")


ADJUST = Step("adjust", 4, adjust_all, Params, check=can_adjust)
