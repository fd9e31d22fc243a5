"""How finely photos see the points of a cloud, and what of it is worth a surface. Import late: loads numba.

A photo that shows a patch of surface in less than a pixel has nothing to say of it. The side of the patch that one
pixel covers, range x the pixel's angle / sqrt(cos of incidence), is what the texture's choice of photos goes by, too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numba import njit, prange

from scan2sim.pipeline.camera.depth_map import depth_map, scene
from scan2sim.pipeline.camera.projection import Eye, Ranges, eye, incidence, is_visible, pixel_of, to_camera, turned
from scan2sim.pipeline.core.step import Report, silent
from scan2sim.pipeline.core.types import F32, F64, Bools, PointCloud, View

PIXELS = 300_000
"""Range images are at most this large: points of decimetres need no finer ones."""
LEAST_COS = 0.02
"""Of incidence; what is seen more edge-on than this is coloured by no photo (`texturing.view_selection.step`)."""


def finest(cloud: PointCloud, views: Sequence[View], *, size: float, coarsest: float, report: Report = silent) -> F32:
    """(N,) metres: side of the smallest patch that a pixel of any photo covers at each point; inf where none sees it.

    Args:
        cloud: with normals; thinned to about one point a voxel of `size` metres. It hides what is behind it.
        views: photos with a perspective.
        size: metres, of the voxels: points hide by discs of it, and may lie so far behind them.
        coarsest: metres; what all pixels cover more coarsely isn't asked for.
        report: progress.
    """
    hides = scene([], cloud, radius=0.8 * size)
    patch = np.full(len(cloud), np.inf, np.float32)
    assert cloud.normal is not None
    for i, view in enumerate(views):
        report(i / len(views), view.name)
        depth = depth_map(view.camera, view.T_world_cam, hides, time=view.time, pixels=PIXELS)
        sees = eye(view.camera, view.T_world_cam)
        _refine(patch, cloud.xyz, cloud.normal, sees, depth.ranges, size, coarsest)
    return patch


@njit(cache=True, parallel=True)
def _refine(patch: F32, xyz: F32, normals: F32, eye: Eye, ranges: Ranges, bias: float, coarsest: float) -> None:
    """Lower `patch` in place to what one photo's pixels cover, where that photo sees the point."""
    for i in prange(len(patch)):
        x, y, z = to_camera(eye.T, xyz[i, 0], xyz[i, 1], xyz[i, 2])
        r = math.sqrt(x * x + y * y + z * z)
        if eye.pixel * r >= min(coarsest, patch[i]) or r < 1e-3:
            continue
        u, v, ok = pixel_of(eye, x, y, z)
        if not ok:
            continue
        nx, ny, nz = turned(eye.T, normals[i, 0], normals[i, 1], normals[i, 2])
        r, cos = incidence(eye, x, y, z, nx, ny, nz)
        side = eye.pixel * r / math.sqrt(max(abs(cos), LEAST_COS))
        if side < patch[i] and is_visible(eye, ranges, u, v, r, cos, bias):
            patch[i] = side


def around(xyz: F32, chosen: Bools, reach: float) -> Bools:
    """(N,) which points are chosen, or within `reach` metres of one that is."""
    from scipy.spatial import cKDTree

    out = chosen.copy()
    if chosen.any():
        rest = np.flatnonzero(~chosen)
        distance, _ = cKDTree(xyz[chosen]).query(xyz[rest], distance_upper_bound=reach, workers=-1)
        out[rest[np.isfinite(distance)]] = True
    return out


def along(xyz: F32, path: F64, reach: float) -> Bools:
    """(N,) which points are within `reach` metres of the path (M, 3) and what is between its places, in plan."""
    from scipy.spatial import cKDTree

    from scan2sim.pipeline.tiling.cut_plan import dense

    distance, _ = cKDTree(dense(path[:, :2])).query(xyz[:, :2], distance_upper_bound=reach, workers=-1)
    return np.isfinite(distance)


def closed(xyz: F32, chosen: Bools, cell: float, gap: float) -> Bools:
    """(N,) which points are in a plan's cells that hold a chosen one, holes and bays up to `gap` metres wide closed."""
    from scipy import ndimage

    if not chosen.any():
        return chosen
    radius = max(1, round(gap / 2 / cell))
    index = np.floor((xyz[:, :2] - xyz[:, :2].min(axis=0)) / cell).astype(np.int64) + radius
    plan = np.zeros(index.max(axis=0) + radius + 1, bool)
    plan[tuple(index[chosen].T)] = True
    disc = np.hypot(*np.mgrid[-radius : radius + 1, -radius : radius + 1]) <= radius + 0.5
    return np.asarray(ndimage.binary_closing(plan, disc)[tuple(index.T)])
