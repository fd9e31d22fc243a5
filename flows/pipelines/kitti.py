"""Import of KITTI's drives with poses that are checked against the sweeps, and corrected if that improves them."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from scan2sim.flows.pipelines.graph import Task
from scan2sim.flows.pipelines.uncached import CHECKED, run_check
from scan2sim.pipeline.core.step import Report, silent
from scan2sim.pipeline.importers.kitti_odometry import poses_of, read_sequence
from scan2sim.pipeline.importers.kitti_raw import Drive, calibration_files, find_drive, read_drive, write_drive_tile
from scan2sim.pipeline.io import trajectory_check as check_io
from scan2sim.pipeline.io.tile_folder import check_target
from scan2sim.slam.geometry import exp_so3
from scan2sim.slam.steps.adjust_kitti import ADJUST_KITTI, AdjustKittiParams
from scan2sim.slam.trajectory.strip_adjustment import PoseSource

Frames = tuple[int, int] | None


def import_kitti_raw(
    drive: Path,
    out: Path,
    *,
    poses: Path | None = None,
    cameras: Sequence[str] = ("image_02",),
    frames: Frames = None,
    pose_source: PoseSource = "auto",
    trajectory_check: Path | None = None,
    max_range: float = 50.0,
    deskew: bool = True,
    vertical_angle_offset: float = 0.0,
    link: bool = False,
    overwrite: bool = False,
    name: str | None = None,
    warn: Callable[[str], None] = lambda _: None,
    report: Report = silent,
) -> Path:
    """Create a tile from a KITTI raw drive (synced and rectified), with poses that are checked against its sweeps.

    Points get the colour of the photo of their own frame, otherwise that of the nearest coloured point nearby,
    otherwise grey. Times are seconds since 1980-01-06, from the drive's time stamps.

    Args:
        drive: the `..._sync` folder, or a folder that contains exactly one; calibration files are searched in it and in
            its parent.
        out: folder of the tile to create.
        poses: row-major 3x4 matrices, one per line, scanner of sweep i to scanner of sweep 0; default: OXTS poses.
        cameras: folders of photos.
        frames: first and last frame number; default: all frames.
        pose_source: "given" uses the poses as they are; "auto" checks them against the sweeps, and corrects them if
            surfaces that were scanned at different times agree clearly better then; "fused" always corrects them.
        trajectory_check: result of the task `raw_check`, if it was run already.
        max_range: metres; farther returns are removed (a pose error of 0.1 degrees is 9 cm at 50 m).
        deskew: transform each point by the pose of its own time; disable for sweeps that are already
            motion-compensated (such as those of KITTI odometry).
        vertical_angle_offset: degrees by which the beams are raised, to correct the scanner's calibration.
        link: symlink photos instead of copying them.
        overwrite: replace an existing tile.
        name: name of the tile; default: that of the drive.
        warn: receives what the check finds.
        report: receives progress.

    Returns:
        Path of the `tile.toml`; `trajectory_check.json` beside it has the result of the check.

    Raises:
        InputError: a file is missing or damaged. SettingError: `out` is not empty, or no frame is selected.
        DataError: no points are within range.
    """
    found = read_drive(drive, poses=poses, cameras=cameras, frames=frames, name=name)
    offset = vertical_angle_offset
    check = partial(raw_check, drive, poses=poses, deskew=deskew, vertical_angle_offset=offset, frames=frames)
    task = None if pose_source == "given" else check(pose_source)
    return _write(
        found, out, task, trajectory_check, warn, report,
        max_range=max_range, deskew=deskew, vertical_angle_offset=offset, link=link, overwrite=overwrite,
    )  # fmt: skip


def import_kitti_odometry(
    sequence: Path,
    out: Path,
    *,
    poses: Path | None = None,
    cameras: Sequence[str] = ("image_2",),
    frames: Frames = None,
    pose_source: PoseSource = "auto",
    trajectory_check: Path | None = None,
    max_range: float = 50.0,
    vertical_angle_offset: float = 0.0,
    labels: Path | None = None,
    link: bool = False,
    overwrite: bool = False,
    name: str | None = None,
    warn: Callable[[str], None] = lambda _: None,
    report: Report = silent,
) -> Path:
    """Create a tile from a KITTI odometry sequence, with poses that are checked against its sweeps.

    Args:
        sequence: folder with velodyne/, image_2/ ..., calib.txt and times.txt.
        poses: poses of camera 0, row-major 3x4, one per line; default: `poses.txt` in the sequence, or the data set's
            `../../poses/<sequence>.txt`.
        trajectory_check: result of the task `odometry_check`, if it was run already.
        labels: folder of labels (`NNNNNN.label`) of SemanticKITTI, or predicted in its format: the points' classes.
        out, cameras, frames, pose_source, max_range, vertical_angle_offset, link, overwrite, name, warn, report: as in
            `import_kitti_raw`.

    Returns:
        Path of the `tile.toml`.

    Raises:
        ScanError: as `import_kitti_raw`.
    """
    found = read_sequence(sequence, poses=poses, cameras=cameras, frames=frames, name=name, labels=labels)
    if labels is None and (sequence / "labels").is_dir():
        warn(f"{sequence / 'labels'}: labels of SemanticKITTI aren't used; --labels {sequence / 'labels'} uses them")
    if labels and (unlabelled := set(found.sweeps) - set(found.labels)):
        warn(f"{labels}: no labels of {len(unlabelled)} sweeps, such as {min(unlabelled)}: their points have no class")
    offset = vertical_angle_offset
    check = partial(odometry_check, sequence, poses=poses, vertical_angle_offset=offset, frames=frames)
    task = None if pose_source == "given" else check(pose_source)
    return _write(
        found, out, task, trajectory_check, warn, report,
        max_range=max_range, deskew=False, vertical_angle_offset=offset, link=link, overwrite=overwrite,
    )  # fmt: skip


def raw_check(
    drive: Path,
    pose_source: PoseSource,
    *,
    poses: Path | None = None,
    deskew: bool = True,
    vertical_angle_offset: float = 0.0,
    frames: Frames = None,
) -> Task:
    """The task that checks the poses of a raw drive; arguments and errors as in `import_kitti_raw`."""
    drive = find_drive(drive)
    files = calibration_files(drive)
    for name in ("velodyne_points", "oxts"):
        if (drive / name).is_dir():  # a folder's digest is that of the files in it, not in its subfolders
            files |= {name: drive / name, f"{name}.data": drive / name / "data"}
    if poses is not None:
        files["poses"] = poses
    params = AdjustKittiParams(
        pose_source=pose_source, frames=frames, deskew=deskew, vertical_angle_offset=vertical_angle_offset
    )
    return Task(ADJUST_KITTI, params, files)


def odometry_check(
    sequence: Path,
    pose_source: PoseSource,
    *,
    poses: Path | None = None,
    vertical_angle_offset: float = 0.0,
    frames: Frames = None,
) -> Task:
    """The task that checks the poses of a sequence; arguments and errors as in `import_kitti_odometry`."""
    files = {"velodyne": sequence / "velodyne", "poses": poses or poses_of(sequence)}
    files |= {name: sequence / f"{name}.txt" for name in ("calib", "times")}
    params = AdjustKittiParams(
        pose_source=pose_source, data="odometry", frames=frames, deskew=False,
        vertical_angle_offset=vertical_angle_offset,
    )  # fmt: skip
    return Task(ADJUST_KITTI, params, files)


def _write(
    drive: Drive,
    out: Path,
    task: Task | None,
    check: Path | None,
    warn: Callable[[str], None],
    report: Report,
    **options: Any,
) -> Path:
    """Create the tile of a drive, with the files of a check beside it, which `task` makes if there is none."""
    check_target(out, options["overwrite"])
    if task is None:
        return write_drive_tile(drive, out, report=report, **options)
    with tempfile.TemporaryDirectory() as folder:
        if check is None:
            check = run_check(task, Path(folder), warn, report)
        correction = check_io.read_correction(check)
        if correction is not None:
            T = drive.T_velo.copy()
            T[:, :3, 3] += correction[:, 1:4]
            T[:, :3, :3] = exp_so3(correction[:, 4:7]) @ T[:, :3, :3]
            drive = replace(drive, T_velo=T)
        tile = write_drive_tile(
            drive, out, report=lambda part, text="": report(CHECKED + (1 - CHECKED) * part, text), **options
        )
        check_io.copy(check, tile.parent)
    return tile
