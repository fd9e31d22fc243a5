"""Sweeps: selects sweeps of the scanner to score the world by, and holds them out of the cloud."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import AfterValidator, Field

from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F64, I64, Bools, PointCloud, Trajectory
from scan2sim.pipeline.io.file_checks import link_or_copy
from scan2sim.pipeline.lidar.sweeps import (
    Sweeps,
    covered_share,
    every_nth,
    scanner_origins,
    sweep_numbers,
    upright_axes,
)

SCORED_EVERY = 8
"""Every Nth sweep is scored if none is held out."""
MAX_SCORED = 40
"""Maximum number of sweeps that are scored."""
MIN_COVERED = 0.9
"""Minimum share of the held-out returns that must lie next to points of other sweeps: below it, each location was
scanned once, and the world would have gaps without the held-out sweeps."""


def _not_all(every: int) -> int:
    if every == 1:
        raise ValueError("every sweep would be held out of the cloud")
    return every


class SweepsParams(Params):
    """The sweeps of a scanner.

    Attributes:
        hold_out: hold every Nth sweep out of the cloud, to score the world by them; 0: none, it is scored by its own.
    """

    hold_out: Annotated[int, AfterValidator(_not_all)] = Field(
        0, ge=0, le=1_000_000, json_schema_extra={"range": "a whole number, 0 or 2 to 1,000,000"}
    )


def sweeps(inputs: Inputs, params: SweepsParams, out: Path, report: Report) -> Done:
    """Split the static `cloud` (after `dynamic_objects`) into sweeps by its times and the scanner's `path`.

    Files: `cloud`, without held-out sweeps (linked if there are none); `sweeps`, a `Sweeps` of those that are scored.
    Metrics: `sweeps`, their number in the cloud; `scored` and `held_out`, numbers of those; `reason` why there are
    none, or "".
    """
    report(0.0, "reading")
    cloud, path = PointCloud.load(inputs["cloud"]), Trajectory.load(inputs["path"])
    origins, reason = scanner_origins(cloud, path)
    held, scored = np.zeros(len(cloud), bool), np.zeros(len(cloud), bool)
    number, warnings, count = np.zeros(len(cloud), np.int64), list[str](), 0
    if not reason and cloud.time is not None:
        report(0.2, "finding sweeps")
        number = sweep_numbers(cloud.time, path.times[np.isfinite(path.times)])
        count = int(number.max()) + 1
        chosen = every_nth(count, params.hold_out or SCORED_EVERY)
        if params.hold_out:
            report(0.4, "holding out")
            held, warnings = _hold_out(cloud, np.isin(number, chosen), count, params.hold_out)
        scored = np.isin(number, chosen[:: -(-len(chosen) // MAX_SCORED)]) & np.isfinite(origins[:, 0])
    report(0.7, "writing")
    if held.any():
        cloud.take(~held).save(out / "cloud.npz")
    else:
        link_or_copy(inputs["cloud"], out / "cloud.npz")
    _select(cloud, origins, path, number, np.flatnonzero(scored)).save(out / "sweeps.npz")
    metrics = {
        "sweeps": count,
        "scored": len(np.unique(number[scored])),
        "held_out": len(np.unique(number[held])),
        "reason": reason,
    }
    return Done({name: out / f"{name}.npz" for name in ("cloud", "sweeps")}, metrics, warnings)


def _hold_out(cloud: PointCloud, held: Bools, count: int, every: int) -> tuple[Bools, list[str]]:
    """The points (N,) that are held out of `held` (N,), all or none, and warnings; `count`: number of all sweeps."""
    none = np.zeros(len(cloud), bool)
    if count < every:
        return none, [f"{count} sweeps are too few to hold out every {every}th: none is held out"]
    covered = covered_share(cloud.xyz[held], cloud.xyz[~held])
    if covered < MIN_COVERED:
        return none, [
            f"no sweep is held out: only {covered:.0%} of their returns lie next to points of other sweeps, so the "
            "world would have gaps without them; it is scored by sweeps that it was made from"
        ]
    return held, []


def _select(cloud: PointCloud, origins: F64, path: Trajectory, number: I64, index: I64) -> Sweeps:
    """The returns `index` of the cloud."""
    if not len(index) or cloud.time is None:
        none = np.zeros((0, 3), np.float32)
        return Sweeps(none, none.astype(np.float64), np.zeros(0, np.int32), none, np.zeros(0))
    xyz, begin, time = cloud.xyz[index], origins[index], cloud.time[index]
    return Sweeps(xyz, begin, number[index].astype(np.int32), upright_axes(xyz - begin, path, time), time)


SWEEPS = Step("sweeps", 1, sweeps, SweepsParams, memory=(0.5, 8))
