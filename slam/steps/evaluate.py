"""Evaluate: a trajectory's errors against a truth (D3.2, section 4.1)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import GpsTrack, Trajectory
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.slam.trajectory.evaluate import SEGMENT, evaluate, read_truth

LOST = 0.5
"""Of the way: where more was bridged than this, nothing is measured."""


class EvaluateParams(Params):
    """What is measured.

    Attributes:
        segment: metres of the local error's segments; set by the recipe.
    """

    segment: Annotated[float, Field(ge=1, le=1e7)] = SEGMENT


def evaluate_path(inputs: Inputs, params: EvaluateParams, out: Path, report: Report) -> Done:
    """Errors of `trajectory` against `truth`, a trajectory or a GPS track; none where most of the way was bridged."""
    path, truth = trajectory_io.read(inputs["trajectory"]), read_truth(inputs["truth"])
    share = lost(path, truth)
    facts = {"lost_share": round(share, 4)}
    if share > LOST:
        return Done({}, facts | {"reason": f"lost for {100 * share:.0f} % of the way"})
    return Done({}, facts | evaluate(path, truth, segment=params.segment).figures())


def lost(estimate: Trajectory, truth: Trajectory | GpsTrack) -> float:
    """The share of the true way on which poses were bridged."""
    assert estimate.unsure is not None
    places = truth.at(estimate.times)[:, :2]
    known = np.isfinite(places).all(axis=1)
    steps = np.linalg.norm(np.diff(places[known], axis=0), axis=1)
    whole = float(steps.sum())
    return float(steps[estimate.unsure[known][1:]].sum()) / whole if whole > 0 else 1.0


EVALUATE = Step("evaluate", 1, evaluate_path, EvaluateParams)
