"""Correction of a scanner's path, and of all that was positioned by that path: points, photos, the path itself.

The correction moves what the scanner measured at a time as a rigid body: by a shift of the scanner's position, and a
rotation about it. Between the times at which it is known, both are interpolated linearly.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.types import F64, Bools, Frame, PointCloud, Trajectory
from scan2sim.pipeline.io import clouds as cloud_io
from scan2sim.pipeline.io import trajectory_check
from scan2sim.pipeline.io.clouds import las

MAX_BEYOND_S = 5.0
"""Seconds before the first and after the last pose within which the nearest correction applies."""


@dataclass(frozen=True)
class PathCorrection:
    """Correction of a path.

    Attributes:
        path: given path of the scanner, metres in the CRS's axes.
        times: (N,) seconds, clock of the path, ascending.
        shift: (N, 3) metres that are added to the scanner's position.
        turn: (N, 3) rotation vectors about the scanner's position, radians.
    """

    path: Trajectory
    times: F64
    shift: F64
    turn: F64

    def covers(self, times: F64) -> Bools:
        """Whether (N,) the path has poses near these times; what was measured at others isn't moved."""
        start, end = float(self.path.times[0]), float(self.path.times[-1])
        return np.asarray((times > start - MAX_BEYOND_S) & (times < end + MAX_BEYOND_S))

    def points(self, xyz: F64, times: F64) -> F64:
        """Points (N, 3) that were measured at `times` (N,), corrected; metres in the CRS's axes."""
        good = self.covers(times)
        centre = self.path.at(times[good])
        moved = xyz.copy()
        moved[good] = self._rotation(times[good]).apply(xyz[good] - centre) + centre + self._at(self.shift, times[good])
        return moved

    def poses(self, T: F64, times: F64) -> F64:
        """Poses (N, 4, 4) of a sensor on the vehicle at `times` (N,), corrected."""
        moved = T.copy()
        moved[:, :3, 3] = self.points(T[:, :3, 3], times)
        good = self.covers(times)
        moved[good, :3, :3] = self._rotation(times[good]).as_matrix() @ T[good, :3, :3]
        return moved

    def trajectory(self) -> Trajectory:
        """The corrected path."""
        rotations = self.path.rotations
        if rotations is not None:
            rotations = self._rotation(self.path.times).as_matrix() @ rotations
        positions = self.path.positions + self._at(self.shift, self.path.times)
        return replace(self.path, positions=positions, rotations=rotations)

    def nearest_times(self, positions: F64) -> F64:
        """Times (N,) at which the path is nearest to positions (N, 3)."""
        from scipy.spatial import cKDTree

        return np.asarray(self.path.times[cKDTree(self.path.positions).query(positions)[1]])

    def _at(self, values: F64, times: F64) -> F64:
        return np.stack([np.interp(times, self.times, values[:, k]) for k in range(3)], axis=-1)

    def _rotation(self, times: F64) -> Any:
        from scipy.spatial.transform import Rotation

        return Rotation.from_rotvec(self._at(self.turn, times))


def read_correction(check: Path, path: Trajectory) -> PathCorrection | None:
    """Correction in the folder of a check (`pipeline.io.trajectory_check`); None if it has none.

    Args:
        check: the folder.
        path: the given path of the scanner, metres in the CRS's axes.

    Raises:
        InputError: the file is damaged.
    """
    table = trajectory_check.read_correction(check)
    return None if table is None else PathCorrection(path, table[:, 0], table[:, 1:4], table[:, 4:7])


def write_corrected(cloud: Path, out: Path, correction: PathCorrection, frame: Frame) -> None:
    """Write a corrected cloud: a LAS or LAZ file with all its attributes, any other as LAZ.

    Args:
        cloud: points with times, clock of the path.
        out: file to write (.las, .laz).
        correction: of the path by which the cloud was made.
        frame: CRS and unit of the cloud.

    Raises:
        ScanError: the cloud can't be read. SpaceError: the disk is full.
    """
    if cloud.suffix.lower() in las.SUFFIXES:
        las.rewrite(cloud, out, lambda xyz, times: correction.points(xyz * frame.unit, times) / frame.unit)
    else:
        las.write_parts(out, _corrected(cloud, correction, frame), software="")


def _corrected(cloud: Path, correction: PathCorrection, frame: Frame) -> Iterator[PointCloud]:
    for part in cloud_io.chunks(cloud, frame):
        assert part.time is not None
        world = part.xyz + np.asarray(part.frame.origin)
        xyz = correction.points(world, part.time) - np.asarray(part.frame.origin)
        yield replace(part, xyz=xyz.astype(np.float32))
