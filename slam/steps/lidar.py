"""Step `lidar`: lidar odometry over a scanner's sweeps, resumed from a checkpoint if it was interrupted."""

from __future__ import annotations

import time as clock
from pathlib import Path

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.errors import DataError, InputError
from scan2sim.pipeline.core.optional_deps import require
from scan2sim.pipeline.core.parameters import Metres
from scan2sim.pipeline.core.step import Done, Inputs, Report, Step
from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.importers.deskew import DeskewParams, half_scan_period, point_time_offsets
from scan2sim.pipeline.io.sweep_files import DEFAULT_RATE_HZ, file_times, list_files, read_sweep
from scan2sim.slam.lidar_odometry import (
    MODEL,
    LidarOdometry,
    Measured,
    initialized_odometry,
)
from scan2sim.slam.odometry.checkpoint import InvalidCheckpoint, load, save

CHECKPOINT_INTERVAL_S = 60.0


class LidarParams(DeskewParams):
    """Settings of the sweeps' registration."""

    min_range: Metres = Field(1.0, description="Ignore returns nearer than this, which hit the car itself; metres.")


def lidar(inputs: Inputs, params: LidarParams, out: Path, report: Report, checkpoint: Path) -> Done:
    """Lidar odometry over `sweeps` (a folder), with an optional file of their `times`.

    Raises:
        InputError: a sweep can't be read, or the times don't increase.
        DataError: there is only one sweep, or all are empty.
    """
    files = list_files(inputs["sweeps"])
    if len(files) < 2:
        raise DataError(inputs["sweeps"], "holds only one sweep: lidar odometry needs two", "Give a trajectory")
    times, known = _times(inputs, files)
    half = half_scan_period(params, times, times)

    def read(i: int) -> Measured:
        sweep = read_sweep(files[i]).between(params.min_range, MODEL.max_range_m)
        return Measured(
            float(times[i]), sweep.xyz, point_time_offsets(sweep, float(times[i]), half, params.deskew, files[i])
        )

    state, saved = checkpoint / "state.npz", clock.perf_counter()
    odometry = _new_or_resumed(state, params.min_range)
    if not odometry.poses:
        first = [read(i) for i in range(min(MODEL.init_sweeps, len(files)))]
        odometry = initialized_odometry(first, params.min_range)
    for i in range(len(odometry.poses), len(files)):
        odometry.add(*read(i))
        report((i + 1) / len(files), f"{i + 1} sweeps")
        if clock.perf_counter() - saved > CHECKPOINT_INTERVAL_S:
            saved = clock.perf_counter()
            save(state, odometry, ())
    if not len(odometry.map_points):
        raise DataError(inputs["sweeps"], "has no points within range", "Check the files and --min-range")
    matched = odometry.matched()
    warnings = [] if known else [f"the sweeps have no times: {DEFAULT_RATE_HZ:g} sweeps per second are assumed"]
    apart = int((matched.overlap < MODEL.overlap_min).sum())
    if apart:
        warnings.append(f"{apart} of {len(files)} sweeps hardly overlap with the previous sweep")
    metrics = {"sweeps": len(files), "matched_surely": round(float(matched.sure.mean()), 4)}
    return Done({"matched": matched.save(out / "matched.npz")}, metrics, warnings)


def _times(inputs: Inputs, files: list[Path]) -> tuple[F64, bool]:
    """(N,) seconds, and whether they are known; otherwise a default rate is assumed.

    Raises:
        InputError: the times don't increase.
    """
    times = file_times(files, inputs.get("times"))
    if times is None:
        return np.arange(len(files)) / DEFAULT_RATE_HZ, False
    late = np.flatnonzero(np.diff(times) <= 0)
    if len(late):
        file = files[late[0] + 1]
        raise InputError(
            file, "its time isn't later than that of the previous sweep", "Fix the times; they must increase"
        )
    return times, True


def _new_or_resumed(state: Path, min_range: float) -> LidarOdometry:
    """A new odometry, or an interrupted one restored from its checkpoint."""
    odometry = LidarOdometry(min_range)
    if state.is_file():
        try:
            load(state, odometry, ())
        except InvalidCheckpoint:
            return LidarOdometry(min_range)
    return odometry


def can_match(params: LidarParams) -> None:
    """Raise UnavailableError if kiss-icp isn't installed."""
    require("sweeps without a trajectory", "kiss_icp", instead="or give a trajectory")


LIDAR = Step("lidar", 1, lidar, LidarParams, check=can_match, resumes=True, memory=(1.0, 0))
