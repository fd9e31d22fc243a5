"""Deskewing (motion compensation): the time of each point of a sweep."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.step import Params
from scan2sim.pipeline.core.types import F32, F64
from scan2sim.pipeline.importers.scanner_path import MAX_POSE_GAP_S
from scan2sim.pipeline.io.sweep_files import DEFAULT_RATE_HZ, Sweep


class DeskewParams(Params):
    """Motion compensation (deskewing): when each point of a sweep was measured.

    Attributes:
        deskew: transform each point by the pose at its own time, for sweeps that aren't motion-compensated. "kitti":
            the scanner rotates clockwise and points forward (x) at the sweep's time; "times": the points have times
            (.pcd, .ply, .las, .laz), in the clock of the sweeps' times, or relative to the sweep's time.
        period: duration of a rotation in seconds, for `deskew`; default: the time between sweeps.
    """

    deskew: Literal["none", "kitti", "times"] = Field(
        "none", description="Motion compensation: none, kitti (rotating scanner), or times (the points have times)."
    )
    period: Annotated[float, Field(ge=0.0001, le=1000)] | None = Field(
        None, description="Duration of a rotation of the scanner in seconds; default: the time between sweeps."
    )


def half_scan_period(placing: DeskewParams, sweeps: F64, poses: F64) -> float:
    """Half the duration of a sweep, seconds, 0 without deskewing; from the setting or the times of sweeps or poses."""
    if placing.deskew == "none":
        return 0.0
    if placing.period is not None:
        return placing.period / 2
    spacing = np.diff(np.unique(sweeps)) if len(sweeps) > 1 else np.diff(poses)
    return (float(np.median(spacing)) if len(spacing) else 1 / DEFAULT_RATE_HZ) / 2


def point_time_offsets(sweep: Sweep, time: float, half_period: float, deskew: str, file: Path) -> F64:
    """Time (N,) of each point relative to the sweep's `time`, seconds, according to `DeskewParams.deskew`.

    Times of points are in the clock of `time`, or relative to it (or to the start of the sweep).

    Raises:
        InputError: the points must have times but don't, or these are in another clock.
    """
    if deskew == "none" or not len(sweep.xyz):
        return np.zeros(len(sweep.xyz))
    if deskew == "kitti":
        return (2 * scan_phase(sweep.xyz) - 1) * half_period
    if sweep.time is None:
        raise InputError(file, "has no times for its points", "Use --deskew kitti, or none")
    for offsets in (sweep.time - time, sweep.time):
        if np.abs(offsets).max() < MAX_POSE_GAP_S:
            return offsets
    cause = f"its points have times from {sweep.time.min():.2f} to {sweep.time.max():.2f} s, the sweep has {time:.2f} s"
    raise InputError(file, cause, "Give the sweeps' times in the points' clock, or --deskew none")


def scan_phase(xyz: F32) -> F64:
    """Time (N,) of each point within its sweep, 0 to 1, for a scanner (z up, x forward) like KITTI's.

    It rotates clockwise, starts and ends pointing backwards, and points forward in the middle.
    """
    return 0.5 - np.arctan2(xyz[:, 1], xyz[:, 0], dtype=np.float64) / (2 * np.pi)
