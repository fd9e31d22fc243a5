"""Normals of points, oriented towards the scanner."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import open3d as o3d
from scipy.spatial import cKDTree

from scan2sim.pipeline.core.types import F32, F64, PointCloud, Trajectory

STEEP_MAX_NORMAL_Z = 0.3  # |nz| below which "up" doesn't define the outside of a surface
QUERY_CHUNK = 20_000  # points per neighbour query
BUILDING_RADIUS_M = 3.0  # radius around a wall point in which the mass of its building is measured
BUILDING_CELL_M = 0.5  # cells of equal mass
MIN_MASS_DISTANCE_M = 0.05  # of a wall from the mass around it; a free-standing one has no outside
FREE_STANDING_SIDE = (0.924, 0.383, 0.0)  # towards which those face: neither along nor diagonal to the axes


def oriented_normals(cloud: PointCloud, neighbours: int, path: Trajectory | None) -> PointCloud:
    """The cloud with unit normals (N, 3): smallest principal axis of `neighbours`, oriented towards the scanner.

    With a path and GPS times that overlap, each normal is oriented to the scanner's position at the point's time;
    without times, to the nearest point of the path; without a path, upwards and, if steep, away from the mass around
    the point, or, without such mass (a free-standing wall), to the same side everywhere.
    """
    if len(cloud) < 3:
        return replace(cloud, normal=np.tile(np.array([0, 0, 1], np.float32), (len(cloud), 1)))
    normal = normals(cloud.xyz, neighbours)
    toward = _away_from_mass(cloud.xyz, normal) if path is None else scanner_positions(cloud, path) - cloud.xyz
    normal[np.einsum("ij,ij->i", normal, toward) < 0] *= -1
    return replace(cloud, normal=normal)


def normals(xyz: F32, neighbours: int) -> F32:
    """Unit normals (N, 3) of at least three points (N, 3), with arbitrary sign."""
    points = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(xyz.astype(np.float64)))
    points.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(min(neighbours, len(xyz))))
    return np.asarray(points.normals).astype(np.float32)


def scanner_positions(cloud: PointCloud, path: Trajectory) -> F64:
    """Scanner position (N, 3) at each point's time, or else the position of the path that is nearest to it."""
    times = cloud.time
    if times is not None and len(path.times) > 1:
        inside = (times >= path.times[0] - 1) & (times <= path.times[-1] + 1)
        if inside.mean() > 0.99:
            return path.at(times)
    return path.positions[cKDTree(path.positions).query(cloud.xyz, workers=-1)[1]]


def _away_from_mass(xyz: F32, normal: F32) -> npt.NDArray[np.floating]:
    """Directions (N, 3) to the outside for airborne clouds: up, and for steep surfaces away from the points around.

    The mass is measured from means of points, not centres of cells, whose side of a wall depends on where it stands.
    """
    from scan2sim.pipeline.geometry.voxel_grid import voxel_groups

    toward = np.tile(np.array([0.0, 0.0, 1.0]), (len(xyz), 1))
    steep = np.flatnonzero(np.abs(normal[:, 2]) < STEEP_MAX_NORMAL_Z)
    if len(steep):
        order, starts = voxel_groups(xyz, BUILDING_CELL_M)
        count = np.diff(np.append(starts, len(order)))[:, None]
        coarse = np.add.reduceat(xyz[order].astype(np.float64), starts, axis=0) / count
        tree = cKDTree(coarse)
        for at in range(0, len(steep), QUERY_CHUNK):  # in chunks: lists of neighbours are large
            here = steep[at : at + QUERY_CHUNK]
            near = tree.query_ball_point(xyz[here], BUILDING_RADIUS_M, workers=-1)
            toward[here] = [xyz[i] - coarse[j].mean(axis=0) for i, j in zip(here, near, strict=True)]
        toward[steep, 2] = 0
        distance = np.einsum("ij,ij->i", toward, normal)
        toward[steep[np.abs(distance[steep]) < MIN_MASS_DISTANCE_M]] = FREE_STANDING_SIDE
    return toward
