"""Normals of points, oriented to where the scanner was."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import open3d as o3d
from scipy.spatial import cKDTree

from scan2sim.pipeline.core.types import F32, F64, PointCloud, Trajectory

STEEP = 0.3  # |nz| below which "up" says nothing of a surface's outside
CHUNK = 20_000
WALL_RADIUS = 3.0  # metres around a wall's point in which its building is looked for


def oriented_normals(cloud: PointCloud, neighbours: int, path: Trajectory | None) -> PointCloud:
    """The cloud with unit normals (N, 3): smallest principal axis of `neighbours`, turned to the scanner.

    With a path and GPS times that overlap, each point looks to where the scanner was at its time;
    without times to the nearest point of the path; without a path, up and, where steep, away from
    the mass around it.
    """
    if len(cloud) < 3:
        return replace(cloud, normal=np.tile(np.array([0, 0, 1], np.float32), (len(cloud), 1)))
    normal = normals(cloud.xyz, neighbours)
    toward = _away_from_mass(cloud.xyz, normal) if path is None else _scanner(cloud, path) - cloud.xyz
    normal[np.einsum("ij,ij->i", normal, toward) < 0] *= -1
    return replace(cloud, normal=normal)


def normals(xyz: F32, neighbours: int) -> F32:
    """Unit normals (N, 3) of points (N, 3), three at least, of either sign."""
    points = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(xyz.astype(np.float64)))
    points.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(min(neighbours, len(xyz))))
    return np.asarray(points.normals).astype(np.float32)


def _scanner(cloud: PointCloud, path: Trajectory) -> F64:
    """(N, 3) where the scanner was when it saw each point."""
    times = cloud.time
    if times is not None and len(path.times) > 1:
        inside = (times >= path.times[0] - 1) & (times <= path.times[-1] + 1)
        if inside.mean() > 0.99:
            return path.at(times)
    return path.positions[cKDTree(path.positions).query(cloud.xyz, workers=-1)[1]]


def _away_from_mass(xyz: F32, normal: F32) -> npt.NDArray[np.floating]:
    """(N, 3) directions to the outside, for clouds scanned from above: up, and away from what is near."""
    toward = np.tile(np.array([0.0, 0.0, 1.0]), (len(xyz), 1))
    steep = np.flatnonzero(np.abs(normal[:, 2]) < STEEP)
    if len(steep):
        coarse = np.unique(np.round(xyz / 0.5).astype(np.int32), axis=0).astype(np.float32) * 0.5
        tree = cKDTree(coarse)
        for at in range(0, len(steep), CHUNK):  # lists of neighbours are large
            here = steep[at : at + CHUNK]
            near = tree.query_ball_point(xyz[here], WALL_RADIUS, workers=-1)
            toward[here] = [
                xyz[i] - coarse[j].mean(axis=0) if j else (0, 0, 1) for i, j in zip(here, near, strict=True)
            ]
        toward[steep, 2] = 0
    return toward
