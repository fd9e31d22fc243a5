"""Surface in free space: faces that rays of the scanner pass through on their way to returns behind them.

Reconstruction closes gaps between points, bulges where points are sparse, and covers foliage with a closed skin. A
ray that ended well behind a face contradicts it; a ray that ended at it supports it. Both are counted in cells, since
faces are smaller than the distance of rays (free-space constraint as in Hornung et al., "OctoMap", Autonomous Robots
2013, on the surface instead of in a volume). Import late: it loads Open3D.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F64, I64, Bools, Mesh


@dataclass(frozen=True)
class FreeSpaceModel:
    """Limits."""

    cell: float = 0.25
    """Size of the cells in which rays are counted, metres."""
    behind: float = 0.25
    """Distance of a return behind the plane of a face, metres, from which its ray contradicts the face."""
    min_passes: int = 4
    """Least number of contradicting rays."""
    max_rays: int = 2_000_000
    """Rays beyond that number are left out, evenly."""


MODEL = FreeSpaceModel()


def passed_faces(
    mesh: Mesh, origins: F64, returns: npt.NDArray[np.floating], min_hit_ratio: float, model: FreeSpaceModel = MODEL
) -> Bools:
    """(F,) bool, True for faces in cells that rays pass through, and where few of them end.

    Args:
        mesh: the mesh, local metres.
        origins: (N, 3) scanner positions, local metres.
        returns: (N, 3) returns, local metres.
        min_hit_ratio: share of the rays reaching a cell's surface that end there, below which it is in free space.
        model: limits.
    """
    import open3d as o3d

    if not len(mesh) or not len(returns):
        return np.zeros(len(mesh), bool)
    step = math.ceil(len(returns) / model.max_rays)
    start, end = origins[::step], np.asarray(returns[::step], np.float64)
    length = np.maximum(np.linalg.norm(end - start, axis=1), 1e-9)
    direction = (end - start) / length[:, None]
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(np.ascontiguousarray(mesh.vertices), np.ascontiguousarray(mesh.faces.astype(np.uint32)))
    hits = scene.cast_rays(np.concatenate([start, direction], axis=1, dtype=np.float32))
    distance, face = hits["t_hit"].numpy().astype(np.float64), hits["primitive_ids"].numpy()
    hit = distance < length + model.behind
    where = start[hit] + direction[hit] * distance[hit, None]
    behind = np.abs(np.einsum("ij,ij->i", end[hit] - where, mesh.face_normal[face[hit]]))
    passes = (behind > model.behind) & (distance[hit] < length[hit])
    cells = _cells(np.concatenate([mesh.corners.mean(axis=1), where]), model.cell)
    of_face, of_ray = cells[: len(mesh)], cells[len(mesh) :]
    count = int(cells.max()) + 1
    passed = np.bincount(of_ray[passes], minlength=count)
    ended = np.bincount(of_ray[~passes], minlength=count)
    free = (passed >= model.min_passes) & (ended < min_hit_ratio * (passed + ended))
    return np.asarray(free[of_face])


def _cells(points: npt.NDArray[np.floating], size: float) -> I64:
    """(N,) index of the cell of each point, numbered from 0."""
    index = np.floor(points / size).astype(np.int64)
    index -= index.min(axis=0)
    _, cell = np.unique(np.ravel_multi_index(tuple(index.T), tuple(index.max(axis=0) + 1)), return_inverse=True)
    return np.asarray(cell, np.int64)
