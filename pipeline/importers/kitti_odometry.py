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
from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.importers.kitti_raw import (
    Drive,
    Rig,
    calibration_entry,
    files_by_frame,
    read_poses,
    rectified_rig,
    select_frames,
)
from scan2sim.pipeline.io.images.image import SUFFIXES, size_of
from scan2sim.pipeline.io.sweep_files import read_times


def read_sequence(
    sequence: Path,
    *,
    poses: Path | None = None,
    cameras: Sequence[str] = ("image_2",),
    frames: tuple[int, int] | None = None,
    name: str | None = None,
    labels: Path | None = None,
) -> Drive:
    """Files, calibration and poses of a sequence; arguments as of `flows.pipelines.kitti.import_kitti_odometry`.

    Raises:
        InputError: a file is missing or damaged. SettingError: no frame is selected.
    """
    sweeps = select_frames(files_by_frame(sequence / "velodyne", ".bin"), frames, sequence)
    numbers = list(sweeps)
    photos = {folder: files_by_frame(sequence / folder, SUFFIXES) for folder in cameras}
    T_cam0_velo = np.eye(4)
    T_cam0_velo[:3] = calibration_entry(sequence, "calib.txt", "Tr", 12).reshape(3, 4)
    T_cam0_velo[:3, :3] = nearest_rotation(T_cam0_velo[:3, :3])
    T_cam0 = read_poses(poses or poses_of(sequence), numbers)
    T_first = np.linalg.inv(T_cam0_velo) @ np.linalg.inv(T_cam0[0])  # camera 0 of frame 0 to the first sweep
    times = _times(sequence / "times.txt", numbers)
    return Drive(
        name or sequence.resolve().name,
        sweeps,
        {folder: _rig(sequence, folder, photos[folder], T_cam0_velo) for folder in cameras},
        photos,
        np.repeat(times[:, None], 3, axis=1),
        T_first @ T_cam0 @ T_cam0_velo,
        "local",
        files_by_frame(labels, ".label") if labels else {},
    )


def _rig(sequence: Path, folder: str, photos: dict[int, Path], T_cam0_velo: F64) -> Rig:
    P = calibration_entry(sequence, "calib.txt", f"P{folder.removeprefix('image_')}", 12).reshape(3, 4)
    return rectified_rig(P, T_cam0_velo, *size_of(next(iter(photos.values()))))


def poses_of(sequence: Path) -> Path:
    """The data set's file of a sequence's poses.

    Raises:
        InputError: it isn't there.
    """
    sequence = sequence.resolve()
    candidates = (sequence / "poses.txt", sequence.parent.parent / "poses" / f"{sequence.name}.txt")
    found = next((candidate for candidate in candidates if candidate.is_file()), None)
    if found is None:
        remedy = f"Put the sequence's poses there, or at {candidates[1]}, or give a file with --poses"
        raise InputError(candidates[0], "file not found", remedy)
    return found


def _times(path: Path, numbers: list[int]) -> F64:
    """Times (F,) of the frames, seconds."""
    times = read_times(path)
    if times.ndim != 1 or len(times) <= numbers[-1]:
        raise InputError(path, f"has {len(times)} times, but sweep {numbers[-1]} is selected", "Unpack it again")
    selected = times[numbers]
    if not (np.isfinite(selected).all() and (np.diff(selected) > 0).all()):
        raise InputError(path, "its times are not ascending", "Unpack it again")
    return selected
