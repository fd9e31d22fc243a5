"""The sparse map: all points that odometry kept, and which keyframes saw them where, for COLMAP and for adjustment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2sim.pipeline.camera.models import project
from scan2sim.pipeline.core.types import F64, I32, I64, Trajectory
from scan2sim.pipeline.io.colmap_writer import SparseMap
from scan2sim.slam.mapping.local_map import Landmarks
from scan2sim.slam.mapping.map_file import Mapped
from scan2sim.slam.trajectory.align import Placing


@dataclass(frozen=True)
class Kept:
    """What odometry knows of points.

    Attributes:
        ids: (P,) ascending.
        xyz: (P, 3) in odometry's world.
        point, keyframe: (O,) what is seen, and from where, by point.
        bearing: (O, 3) in which direction.
    """

    ids: I64
    xyz: F64
    point: I32
    keyframe: I32
    bearing: F64


def kept(mapped: Mapped) -> Kept:
    """What odometry, told to `keep`, knows of points: those that two keyframes or more see."""
    known = mapped.map
    ids = np.concatenate([known.landmarks.ids, *(gone.ids for gone in known.retired)])
    xyz = np.concatenate([known.landmarks.xyz, *(gone.xyz for gone in known.retired)])
    ids, first = np.unique(ids, return_index=True)
    seen = known.observations(list(range(len(known.keyframes))))
    rows = np.minimum(np.searchsorted(ids, seen.ids), len(ids) - 1)
    real = ids[rows] == seen.ids
    real &= np.bincount(rows[real], minlength=len(ids))[rows] > 1
    rows = rows[real]
    used = np.unique(rows)
    return Kept(
        ids[used],
        xyz[first][used],
        np.searchsorted(used, rows).astype(np.int32),
        seen.of[real].astype(np.int32),
        seen.bearing[real],
    )


def move(mapped: Mapped, known: Kept, poses: F64, xyz: F64) -> None:
    """Put keyframes and the points of `known` elsewhere: (C, 4, 4), (P, 3)."""
    for keyframe, pose in zip(mapped.map.keyframes, poses, strict=True):
        keyframe.T_world_cam = pose
    alive = np.isin(known.ids, mapped.map.landmarks.ids)
    mapped.map.landmarks = Landmarks(known.ids[alive], xyz[alive])
    mapped.map.retired = [Landmarks(known.ids[~alive], xyz[~alive])]


def sparse_map(mapped: Mapped, placing: Placing, trajectory: Trajectory) -> SparseMap:
    """The points in the trajectory's coordinates, seen from its poses."""
    known = kept(mapped)
    frame_of = np.searchsorted(trajectory.times, [k.time for k in mapped.map.keyframes])
    uv, inside = project(mapped.map.camera, known.bearing)
    frame = frame_of[known.keyframe]
    at: I64 = np.zeros(len(known.xyz), np.int64)
    at[known.point[::-1]] = frame[::-1]
    before = np.stack([mapped.pose_of(p)[:3, 3] for p in mapped.placed])
    points = placing.points(known.xyz, at, before, trajectory)
    return SparseMap(points, known.point[inside], frame[inside].astype(np.int32), uv[inside].astype(np.float64))
