"""Adjust: all keyframes and points of a video at once, afterwards."""

from __future__ import annotations

from pathlib import Path

from scan2sim.pipeline.extras import need
from scan2sim.pipeline.step import Done, Inputs, Params, Report, Step
from scan2sim.slam.adjust import adjust
from scan2sim.slam.mapped import Mapped


def adjust_all(inputs: Inputs, params: Params, out: Path, report: Report) -> Done:
    """Move keyframes and points of `mapped` to where all observations fit best."""
    mapped = Mapped.read(inputs["mapped"])
    facts = adjust(mapped)
    return Done({"mapped": mapped.write(out / "mapped.npz")}, dict(facts))


def can_adjust(params: Params) -> None:
    """Raise an UnavailableError where pycolmap isn't installed."""
    need("--adjust", "pycolmap")


ADJUST = Step("adjust", 2, adjust_all, Params, check=can_adjust)
