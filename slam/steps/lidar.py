"""Lidar: a scanner's sweeps are matched one to the other; goes on where it was killed."""

from __future__ import annotations

import time as clock
from pathlib import Path

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.errors import DataError, InputError
from scan2sim.pipeline.core.optional_deps import need
from scan2sim.pipeline.core.parameters import Metres
from scan2sim.pipeline.core.step import Done, Inputs, Report, Step
from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.importers import sweeps as io
from scan2sim.slam.lidar_odometry import FIRST, OVERLAP, REACH, LidarOdometry, Measured, begun
from scan2sim.slam.odometry.checkpoint import WrongState, load, save

KEEP_EVERY = 60.0
"""Seconds between states kept."""


class LidarParams(io.Turning):
    """How sweeps are matched."""

    min_range: Metres = Field(1.0, description="Metres; nearer returns, the car's own, match nothing.")


def lidar(inputs: Inputs, params: LidarParams, out: Path, report: Report, checkpoint: Path) -> Done:
    """Match `sweeps` (a folder), with their `times` if there is a file of them.

    Raises:
        InputError: a sweep can't be read, or times that don't ascend.
        DataError: there is one sweep alone, or nothing in any.
    """
    files = io.files_of(inputs["sweeps"])
    if len(files) < 2:
        raise DataError(inputs["sweeps"], "holds one sweep, and nothing to match it to", "Give a trajectory")
    times, told = _times(inputs, files)
    half = io.half_turn(params, times, times)

    def read(i: int) -> Measured:
        sweep = io.read_sweep(files[i]).between(params.min_range, REACH)
        return Measured(float(times[i]), sweep.xyz, io.ages(sweep, float(times[i]), half, params.deskew, files[i]))

    state, saved = checkpoint / "state.npz", clock.perf_counter()
    odometry = _begin(state, params.min_range)
    if not odometry.poses:
        odometry = begun([read(i) for i in range(min(FIRST, len(files)))], params.min_range)
    for i in range(len(odometry.poses), len(files)):
        odometry.add(*read(i))
        report((i + 1) / len(files), f"{i + 1} sweeps")
        if clock.perf_counter() - saved > KEEP_EVERY:
            saved = clock.perf_counter()
            save(state, odometry, ())
    if not len(odometry.places):
        raise DataError(inputs["sweeps"], "has no points within range", "Look at the files, and at --min-range")
    matched = odometry.matched()
    warnings = [] if told else [f"nothing tells the sweeps' times: {io.RATE:g} a second are assumed"]
    apart = int((matched.overlap < OVERLAP).sum())
    if apart:
        warnings.append(f"{apart} of {len(files)} sweeps show little of what the one before them shows")
    facts = {"sweeps": len(files), "matched_surely": round(float(matched.sure.mean()), 4)}
    return Done({"matched": matched.save(out / "matched.npz")}, facts, warnings)


def _times(inputs: Inputs, files: list[Path]) -> tuple[F64, bool]:
    """(N,) seconds, and whether anything tells them.

    Raises:
        InputError: they don't ascend.
    """
    times = io.told_times(files, inputs.get("times"))
    if times is None:
        return np.arange(len(files)) / io.RATE, False
    late = np.flatnonzero(np.diff(times) <= 0)
    if len(late):
        place = files[late[0] + 1]
        raise InputError(place, "its time doesn't follow that of the sweep before", "Mend the times; each once")
    return times, True


def _begin(state: Path, near: float) -> LidarOdometry:
    """Where an earlier run was interrupted, or at the beginning."""
    odometry = LidarOdometry(near)
    if state.is_file():
        try:
            load(state, odometry, ())
        except WrongState:
            return LidarOdometry(near)
    return odometry


def can_match(params: LidarParams) -> None:
    """Raise a ScanError where kiss-icp is missing."""
    need("sweeps without a trajectory", "kiss_icp", instead="or give a trajectory")


LIDAR = Step("lidar", 1, lidar, LidarParams, check=can_match, resumes=True, memory=(1.0, 0))
