"""Importer of KITTI odometry sequences (Geiger et al., "Are we ready for autonomous driving?", CVPR 2012).

A row of the poses is camera 0 of frame i to camera 0 of frame 0, `Tr` of calib.txt is scanner to camera 0, P0 to P3
project from rectified camera 0. The tile is local, in the first sweep's axes: x forward, y left, z up. Sweeps of this
data set are already motion-compensated to the time of the photos.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.poses import nearest_rotation
from scan2sim.pipeline.core.step import Report, silent
from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.importers.kitti_raw import (
    Drive,
    Rig,
    calibration_entry,
    files_by_frame,
    read_poses,
    rectified_rig,
    select_frames,
    write_drive_tile,
)
from scan2sim.pipeline.io import file_checks
from scan2sim.pipeline.io.images.image import SUFFIXES, size_of


def import_kitti_odometry(
    sequence: Path,
    out: Path,
    *,
    poses: Path | None = None,
    cameras: Sequence[str] = ("image_2",),
    frames: tuple[int, int] | None = None,
    max_range: float = 50.0,
    link: bool = False,
    overwrite: bool = False,
    name: str | None = None,
    report: Report = silent,
) -> Path:
    """Create a tile from a KITTI odometry sequence.

    Points are coloured, and returns from the recording car removed, as in `kitti_raw.import_kitti_raw`. Times are
    seconds since the start of the sequence.

    Args:
        sequence: folder with velodyne/, image_2/ ..., calib.txt and times.txt.
        out: folder of the tile to create.
        poses: poses of camera 0, row-major 3x4, one per line; default: `poses.txt` in the sequence, or the data set's
            `../../poses/<sequence>.txt`.
        cameras, frames, max_range, link, overwrite, name, report: as in `import_kitti_raw`.

    Returns:
        Path of the `tile.toml`.

    Raises:
        InputError: a file is missing or damaged. SettingError: `out` is not empty, or no frame is selected.
    """
    sweeps = select_frames(files_by_frame(sequence / "velodyne", ".bin"), frames, sequence)
    numbers = list(sweeps)
    photos = {folder: files_by_frame(sequence / folder, SUFFIXES) for folder in cameras}
    T_cam0_velo = np.eye(4)
    T_cam0_velo[:3] = calibration_entry(sequence, "calib.txt", "Tr", 12).reshape(3, 4)
    T_cam0_velo[:3, :3] = nearest_rotation(T_cam0_velo[:3, :3])
    T_cam0 = read_poses(poses or _poses_of(sequence), numbers)
    T_first = np.linalg.inv(T_cam0_velo) @ np.linalg.inv(T_cam0[0])  # camera 0 of frame 0 to the first sweep
    times = _times(sequence / "times.txt", numbers)
    drive = Drive(
        name or sequence.resolve().name,
        sweeps,
        {folder: _rig(sequence, folder, photos[folder], T_cam0_velo) for folder in cameras},
        photos,
        np.repeat(times[:, None], 3, axis=1),
        T_first @ T_cam0 @ T_cam0_velo,
        "local",
    )
    return write_drive_tile(
        drive, out, max_range=max_range, deskew=False, link=link, overwrite=overwrite, report=report
    )


def _rig(sequence: Path, folder: str, photos: dict[int, Path], T_cam0_velo: F64) -> Rig:
    P = calibration_entry(sequence, "calib.txt", f"P{folder.removeprefix('image_')}", 12).reshape(3, 4)
    return rectified_rig(P, T_cam0_velo, *size_of(next(iter(photos.values()))))


def _poses_of(sequence: Path) -> Path:
    sequence = sequence.resolve()
    candidates = (sequence / "poses.txt", sequence.parent.parent / "poses" / f"{sequence.name}.txt")
    found = next((candidate for candidate in candidates if candidate.is_file()), None)
    if found is None:
        remedy = f"Put the sequence's poses there, or at {candidates[1]}, or give a file with --poses"
        raise InputError(candidates[0], "file not found", remedy)
    return found


def _times(path: Path, numbers: list[int]) -> F64:
    """Times (F,) of the frames, seconds."""
    remedy = "Unpack the sequence's times again"
    try:
        times = np.loadtxt(file_checks.check(path, remedy), ndmin=1).astype(np.float64)
    except (OSError, ValueError) as error:
        raise InputError(path, f"is not a list of times ({error})", remedy) from None
    if times.ndim != 1 or len(times) <= numbers[-1]:
        raise InputError(path, f"has {len(times)} times, but sweep {numbers[-1]} is selected", "Unpack it again")
    selected = times[numbers]
    if not (np.isfinite(selected).all() and (np.diff(selected) > 0).all()):
        raise InputError(path, "its times are not ascending", "Unpack it again")
    return selected
