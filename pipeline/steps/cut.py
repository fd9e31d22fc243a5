"""Cut: splits a corridor into the overlapping tiles of a survey."""

from __future__ import annotations

from pathlib import Path

from scan2sim.pipeline.core.step import Done, Inputs, Report, Step
from scan2sim.pipeline.tiling.cut_corridor import VERSION, CutParams, cut_survey


def cut(inputs: Inputs, params: CutParams, out: Path, report: Report) -> Done:
    """Cut the tile `corridor` (a `tile.toml`, or its folder); other inputs are the files that it refers to.

    Raises:
        ScanError: as `cut_survey`.
    """
    warnings: list[str] = []
    survey = cut_survey(inputs["corridor"], out / "survey", params, report=report, warn=warnings.append)
    return Done({"survey": survey.parent}, warnings=warnings)


CUT = Step("cut", VERSION, cut, CutParams)
