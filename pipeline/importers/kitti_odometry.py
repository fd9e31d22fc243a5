"""KITTI odometry sequences (Geiger et al., "Are we ready for autonomous driving?", CVPR 2012) as tiles.

A row of the poses is camera 0 of frame i to camera 0 of frame 0, `Tr` of calib.txt the scanner to camera 0, P0 to P3
project from rectified camera 0. The tile is local, in the first sweep's axes: x ahead, y left, z up. Sweeps of this
set are compensated for the car's motion already, to the moment at which the photos were taken.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from scan2sim.pipeline.camera.poses import nearest_rotation
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.step import Report, silent
from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.importers.kitti_raw import Drive, Rig, assemble, entry, numbered, read_poses, rig, within
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
    """Make a tile of a KITTI odometry sequence.

    Points get colours as in `kitti.import_kitti_raw`; the recording car's own returns are left out as there. Times
    are seconds from the sequence's begin.

    Args:
        sequence: folder of velodyne/, image_2/ ..., calib.txt and times.txt.
        out: the tile's folder to make.
        poses: of camera 0, row-major 3x4, one a line; by default `poses.txt` in the sequence, or the data set's own
            `../../poses/<sequence>.txt`.
        cameras, frames, max_range, link: as in `import_kitti_raw`.

    Returns:
        Path of the `tile.toml`.

    Raises:
        InputError: a file is missing or damaged. SettingError: `out` is not empty, no frame is left.
    """
    sweeps = within(numbered(sequence / "velodyne", ".bin"), frames, sequence)
    numbers = list(sweeps)
    photos = {folder: numbered(sequence / folder, SUFFIXES) for folder in cameras}
    T_cam0_velo = np.eye(4)
    T_cam0_velo[:3] = entry(sequence, "calib.txt", "Tr", 12).reshape(3, 4)
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
    return assemble(drive, out, max_range=max_range, deskew=False, link=link, overwrite=overwrite, report=report)


def _rig(sequence: Path, folder: str, photos: dict[int, Path], T_cam0_velo: F64) -> Rig:
    P = entry(sequence, "calib.txt", f"P{folder.removeprefix('image_')}", 12).reshape(3, 4)
    return rig(P, T_cam0_velo, *size_of(next(iter(photos.values()))))


def _poses_of(sequence: Path) -> Path:
    sequence = sequence.resolve()
    places = (sequence / "poses.txt", sequence.parent.parent / "poses" / f"{sequence.name}.txt")
    found = next((place for place in places if place.is_file()), None)
    if found is None:
        raise InputError(places[0], "is missing", f"Put the sequence's poses there, or at {places[1]}, or name a file")
    return found


def _times(path: Path, numbers: list[int]) -> F64:
    """(F,) seconds."""
    remedy = "Unpack the sequence's times again"
    try:
        times = np.loadtxt(file_checks.check(path, remedy), ndmin=1).astype(np.float64)
    except (OSError, ValueError) as error:
        raise InputError(path, f"is no list of times ({error})", remedy) from None
    if times.ndim != 1 or len(times) <= numbers[-1]:
        raise InputError(path, f"has {len(times)} times, but sweep {numbers[-1]} is asked for", "Unpack it again")
    some = times[numbers]
    if not (np.isfinite(some).all() and (np.diff(some) > 0).all()):
        raise InputError(path, "its times don't ascend", "Unpack it again")
    return some
