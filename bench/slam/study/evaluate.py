"""Step `evaluate`: errors of a trajectory against ground truth (D3.2, section 4.1)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.step import Context, Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import GpsTrack, Trajectory
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.slam.trajectory.evaluate import SEGMENT_M, evaluate, read_truth

LOST_SHARE_MAX = 0.5
"""Share of the path with lost tracking above which errors aren't evaluated."""


class Segments(Context):
    """Lengths of the local error's segments, metres."""

    segments: tuple[Annotated[float, Field(ge=1, le=1e7)], ...] = Field((SEGMENT_M,), min_length=1)


class EvaluateParams(Params):
    """No settings."""

    context: Segments = Segments()


def evaluate_path(inputs: Inputs, params: EvaluateParams, out: Path, report: Report) -> Done:
    """Errors of `trajectory` against `truth`, a trajectory or a GPS track; none if tracking was mostly lost."""
    path, truth = trajectory_io.read(inputs["trajectory"]), read_truth(inputs["truth"])
    share = lost_share(path, truth)
    metrics: dict[str, Any] = {"lost_share": round(share, 4)}
    if share > LOST_SHARE_MAX:
        return Done({}, metrics | {"reason": f"tracking lost on {100 * share:.0f} % of the path"})
    for segment in params.context.segments:
        metrics |= evaluate(path, truth, segment=segment).figures()
    return Done({}, metrics)


def lost_share(estimate: Trajectory, truth: Trajectory | GpsTrack) -> float:
    """Share of the true path's length on which poses are unsure."""
    assert estimate.unsure is not None
    positions = truth.at(estimate.times)[:, :2]
    known = np.isfinite(positions).all(axis=1)
    steps = np.linalg.norm(np.diff(positions[known], axis=0), axis=1)
    whole = float(steps.sum())
    return float(steps[estimate.unsure[known][1:]].sum()) / whole if whole > 0 else 1.0


EVALUATE = Step("evaluate", 3, evaluate_path, EvaluateParams)
