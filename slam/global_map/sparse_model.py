"""Sparse model: all points and observations kept by odometry, for the COLMAP model and global adjustment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2sim.pipeline.camera.models import project
from scan2sim.pipeline.core.types import F64, I32, I64, Frame, Trajectory
from scan2sim.pipeline.io.colmap_writer import SparseMap
from scan2sim.slam.global_map.map_file import MapCheckpoint
from scan2sim.slam.mapping.local_map import Landmarks


@dataclass(frozen=True)
class SparsePoints:
    """Points and observations in odometry's world.

    Attributes:
        ids: (P,) ids of the points, ascending.
        xyz: (P, 3) points.
        point, keyframe: (O,) point and keyframe of each observation, sorted by point.
        bearing: (O, 3) unit vectors of the observations, camera axes.
    """

    ids: I64
    xyz: F64
    point: I32
    keyframe: I32
    bearing: F64


def sparse_points(checkpoint: MapCheckpoint) -> SparsePoints:
    """All points that at least two keyframes observe, of a map that was built with `keep`."""
    local_map = checkpoint.map
    ids = np.concatenate([local_map.landmarks.ids, *(points.ids for points in local_map.retired)])
    xyz = np.concatenate([local_map.landmarks.xyz, *(points.xyz for points in local_map.retired)])
    ids, first = np.unique(ids, return_index=True)
    seen = local_map.observations(list(range(len(local_map.keyframes))))
    rows = np.minimum(np.searchsorted(ids, seen.ids), len(ids) - 1)
    valid = ids[rows] == seen.ids
    valid &= np.bincount(rows[valid], minlength=len(ids))[rows] > 1
    rows = rows[valid]
    used = np.unique(rows)
    return SparsePoints(
        ids[used],
        xyz[first][used],
        np.searchsorted(used, rows).astype(np.int32),
        seen.camera_of[valid].astype(np.int32),
        seen.bearing[valid],
    )


def update_map(checkpoint: MapCheckpoint, known: SparsePoints, poses: F64, xyz: F64) -> None:
    """Replace the poses (C, 4, 4) of all keyframes, and the positions (P, 3) of the points `known`."""
    for keyframe, pose in zip(checkpoint.map.keyframes, poses, strict=True):
        keyframe.T_world_cam = pose
    alive = np.isin(known.ids, checkpoint.map.landmarks.ids)
    checkpoint.map.landmarks = Landmarks(known.ids[alive], xyz[alive])
    checkpoint.map.retired = [Landmarks(known.ids[~alive], xyz[~alive])]


@dataclass(frozen=True)
class Alignment:
    """Transform from odometry's world to that of the trajectory.

    Attributes:
        R: (3, 3) rotation.
        factor: (T - 1,) scale factors of the motions between poses.
        frame: coordinate frame of the result.
    """

    R: F64
    factor: F64
    frame: Frame

    def points(self, xyz: F64, at: I64, before: F64, after: Trajectory) -> F64:
        """Transform points; each moves with the pose that observed it.

        Args:
            xyz: (P, 3) points in odometry's world.
            at: (P,) index of the pose that observed each point.
            before: (T, 3) positions in odometry's world.
            after: the finished trajectory.

        Returns:
            (P, 3) points in the trajectory's frame.
        """
        steps = np.append(self.factor, self.factor[-1:] if len(self.factor) else [1.0])
        return (xyz - before[at]) * steps[at, None] @ self.R.T + after.positions[at]


def sparse_map(checkpoint: MapCheckpoint, alignment: Alignment, trajectory: Trajectory) -> SparseMap:
    """Points and observations in the coordinates of the finished trajectory."""
    known = sparse_points(checkpoint)
    frame_of = np.searchsorted(trajectory.times, [k.time for k in checkpoint.map.keyframes])
    uv, inside = project(checkpoint.map.camera, known.bearing)
    frame = frame_of[known.keyframe]
    at: I64 = np.zeros(len(known.xyz), np.int64)
    at[known.point[::-1]] = frame[::-1]
    before = np.stack([checkpoint.pose_of(p)[:3, 3] for p in checkpoint.placed])
    points = alignment.points(known.xyz, at, before, trajectory)
    return SparseMap(points, known.point[inside], frame[inside].astype(np.int32), uv[inside].astype(np.float64))
