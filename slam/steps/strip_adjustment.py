"""Step `strip_adjustment`: checks a given trajectory against the sweeps, and corrects it where their surfaces allow."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.parameters import Metres, Shift
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.importers.deskew import DeskewParams, half_scan_period, point_time_offsets
from scan2sim.pipeline.importers.scanner_path import ScannerPath
from scan2sim.pipeline.importers.sweeps import (
    MIN_UPRIGHT,
    Box,
    PlacementParams,
    SelectionParams,
    mean_up,
    order_text,
    other_order,
    tilt_warning,
)
from scan2sim.pipeline.io import sweep_files, trajectory_check
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.pipeline.io.calibration import read_extrinsics
from scan2sim.slam import scan_pairs
from scan2sim.slam.geometry import inverse
from scan2sim.slam.trajectory import output
from scan2sim.slam.trajectory.strip_adjustment import (
    MODEL,
    Adjusted,
    PoseSource,
    adjust,
    corrected,
    correction,
    disagreement,
    unchecked,
)


class PoseSourceParams(Params):
    """Which poses are used.

    Attributes:
        pose_source: "given" as they are, "auto" corrected if sweeps agree clearly better then, "fused" always.
    """

    pose_source: PoseSource = Field(
        "auto",
        description="Poses to use: given (as they are), auto (corrected if surfaces that were scanned at different "
        "times agree clearly better then), or fused (always corrected).",
    )


class StripAdjustmentParams(PoseSourceParams, DeskewParams):
    """Settings that relate sweeps and trajectory.

    Attributes:
        scanner_poses: the poses are the scanner's; default: with extrinsics, they are the camera's.
        invert_extrinsics: the extrinsics are T_scanner_camera.
        time_offset: seconds that are added to the times of sweeps.
        min_range: nearer returns (the vehicle) are ignored, metres.
        vehicle_box: points in this box, the vehicle, are ignored; scanner axes: low and high corner, metres.
        crs: projected CRS of the trajectory; "local" without georeference.
        quaternions: order of the trajectory's quaternions.
    """

    scanner_poses: bool = Field(False, description="Treat the poses as scanner poses even if extrinsics are given.")
    invert_extrinsics: bool = Field(
        False, description="The extrinsics are T_scanner_camera: from camera axes to scanner axes."
    )
    time_offset: Shift = Field(0.0, description="Seconds to add to the times of sweeps and photos.")
    min_range: Metres = Field(1.0, description="Ignore returns nearer than this, which hit the car itself; metres.")
    vehicle_box: Box | None = Field(
        None,
        description="Box that contains the vehicle, in scanner axes: x y z of its low and its high corner, metres.",
    )
    crs: str = Field("local", description='CRS of the poses: "EPSG:32633", or "local".')
    quaternions: trajectory_io.QuaternionOrder = Field("xyzw", description=trajectory_io.QUATERNIONS_HELP)


def strip_adjustment(inputs: Inputs, params: StripAdjustmentParams, out: Path, report: Report) -> Done:
    """Trajectory of the scanner from `poses` and `sweeps`, with optional `extrinsics` and `times` of the sweeps.

    Raises:
        InputError: a file is missing or damaged, or sweeps and poses don't match.
        DataError: no sweep has a reliable pose.
    """
    files = sweep_files.list_files(inputs["sweeps"])
    path, frame = trajectory_io.read_local(inputs["poses"], params.crs, params.quaternions)
    extrinsics = "extrinsics" in inputs and not params.scanner_poses
    T_camera_scanner = read_extrinsics(inputs["extrinsics"]) if extrinsics else np.eye(4)
    if params.invert_extrinsics:
        T_camera_scanner = inverse(T_camera_scanner)
    T = path.poses @ T_camera_scanner
    own = {"invert_extrinsics": params.invert_extrinsics, "quaternions": params.quaternions}
    tilt = tilt_warning(path, T_camera_scanner, PlacementParams(scanner_poses=not extrinsics, **own))
    given = ScannerPath(path.times, T, path.unsure)
    seconds = sweep_files.timestamps(files, inputs.get("times"), path, inputs["sweeps"], offset=params.time_offset)
    half = half_scan_period(params, seconds, path.times)
    good = np.flatnonzero(given.usable(seconds, half, f"{len(files)} sweeps", inputs["poses"], lambda _: None))
    good = good[np.concatenate([[True], np.diff(seconds[good]) > 0])]
    times, poses = seconds[good], np.concatenate([given.at(seconds[i : i + 1]) for i in good])

    selection = SelectionParams(
        min_range=params.min_range, max_range=scan_pairs.MODEL.range_m, vehicle_box=params.vehicle_box
    )

    def sweep(i: int, scanner: ScannerPath) -> F64:
        file, time = files[good[i]], float(times[i])
        read = selection.selected(sweep_files.read_sweep(file))
        ages = point_time_offsets(read, time - params.time_offset, half, params.deskew, file)
        world = scanner.to_local(read.xyz, time + ages)
        to_scanner = inverse(scanner.at(times[i : i + 1])[0])
        return world @ to_scanner[:3, :3].T + to_scanner[:3, 3]

    def order_warning() -> list[str]:
        """A warning if sweeps agree clearly better with the quaternions in the other order."""
        other = other_order(params.quaternions)
        T = trajectory_io.reordered(path, other).poses @ T_camera_scanner
        if mean_up(T) < MIN_UPRIGHT:
            return []
        alternative = ScannerPath(path.times, T)
        moved = np.concatenate([alternative.at(times[i : i + 1]) for i in range(len(times))])
        now, then = (disagreement(times, each, sweep) for each in (poses, moved))
        if then > MODEL.gain_max * now:
            return []
        return [f"{order_text(other)} sweeps disagree by {100 * then:.0f} cm instead of {100 * now:.0f} cm"]

    warnings = order_warning() if mean_up(T) < MIN_UPRIGHT else []
    if not warnings and tilt is not None:
        warnings = [tilt]
    if not warnings or params.pose_source == "fused":
        adjusted = adjust(times, poses, sweep, params.pose_source, report=report)
        if not warnings and not adjusted.before.within(MODEL.convention_m):
            warnings = order_warning()
    else:  # poses or extrinsics are of another convention: nothing to correct
        adjusted = unchecked(poses)
    T = corrected(path.times, T, times, poses, adjusted.poses) if adjusted.source == "fused" else T
    output.write(out / "path", replace(path, positions=T[:, :3, 3], rotations=T[:, :3, :3]), frame)
    return Done(
        {
            "path": out / "path",
            "trajectory": out / "path" / "trajectory.csv",
            "check": write_check(out / "check", times, poses, adjusted),
        },
        adjusted.figures(times),
        warnings + adjusted.warnings(),
    )


def write_check(
    folder: Path, times: F64, given: F64, adjusted: Adjusted, notes: Mapping[str, Any] | None = None
) -> Path:
    """Write the files of a check (`pipeline.io.trajectory_check`), with further `notes`; returns their folder."""
    changed = None
    if adjusted.source == "fused":
        changed = np.column_stack([times, *correction(given, adjusted.poses)])
    return trajectory_check.write(folder, adjusted.figures(times) | dict(notes or {}), changed)


STRIP_ADJUSTMENT = Step("strip_adjustment", 1, strip_adjustment, StripAdjustmentParams, memory=(1.0, 0))
