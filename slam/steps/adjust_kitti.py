"""Step `adjust_kitti`: checks the poses of a KITTI drive against its sweeps, and corrects them where surfaces allow."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.step import Done, Inputs, Report, Step
from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.importers.kitti_odometry import read_sequence
from scan2sim.pipeline.importers.kitti_raw import point_times, read_drive, read_drive_sweep
from scan2sim.pipeline.importers.scanner_path import ScannerPath
from scan2sim.slam import scan_pairs
from scan2sim.slam.geometry import inverse
from scan2sim.slam.steps.strip_adjustment import PoseSourceParams, write_check
from scan2sim.slam.trajectory.strip_adjustment import adjust, unchecked


class AdjustKittiParams(PoseSourceParams):
    """Settings of the check of a drive's poses.

    Attributes:
        data: layout of the drive.
        frames: first and last frame number; None: all frames.
        deskew: transform each point by the pose of its own time.
        vertical_angle_offset: degrees by which the sweeps' beams are raised.
    """

    data: Literal["raw", "odometry"] = Field("raw", description="Layout of the drive.")
    frames: tuple[int, int] | None = Field(None, description="First and last frame; default: all.")
    deskew: bool = Field(True, description="Transform each point by the pose of its own time.")
    vertical_angle_offset: float = Field(0.0, description="Degrees by which the beams are raised.")


def adjust_kitti(inputs: Inputs, params: AdjustKittiParams, out: Path, report: Report) -> Done:
    """Check the poses of a drive against its sweeps.

    Args:
        inputs: files and folders that the check depends on: `velodyne_points` (raw) or `velodyne` (odometry) is in the
            drive's folder, `poses` a file of poses.
        params: settings.
        out: folder for the result.
        report: receives progress.

    Returns:
        `check`: folder with the files of `pipeline.io.trajectory_check`.

    Raises:
        ScanError: a file is missing or damaged.
    """
    read, folder = (read_drive, "velodyne_points") if params.data == "raw" else (read_sequence, "velodyne")
    drive = read(inputs[folder].parent, poses=inputs.get("poses"), cameras=(), frames=params.frames)
    times, files = drive.spans[:, 1], list(drive.sweeps.values())
    given = drive.T_velo.copy()
    given[:, :3, 3] -= np.floor(given[0, :3, 3])

    def sweep(i: int, path: ScannerPath) -> F64:
        start, middle, end = drive.spans[i].tolist()
        read = read_drive_sweep(files[i], scan_pairs.MODEL.range_m, params.vertical_angle_offset)
        world = path.to_local(read.xyz, point_times(read, start, end, params.deskew))
        to_scanner = inverse(path.at(np.array([middle]))[0])
        return world @ to_scanner[:3, :3].T + to_scanner[:3, 3]

    if len(times) > 1 and (np.diff(times) > 0).all():
        adjusted = adjust(times, given, sweep, params.pose_source, report=report)
    else:  # the import rejects such times
        adjusted = unchecked(given)
    check = write_check(out / "check", times, given, adjusted)
    return Done({"check": check}, adjusted.figures(times), adjusted.warnings())


ADJUST_KITTI = Step("adjust_kitti", 1, adjust_kitti, AdjustKittiParams, memory=(1.0, 0))
