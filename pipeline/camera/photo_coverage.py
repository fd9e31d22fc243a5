"""Photo coverage: ground sample distance (GSD) of points in the photos, and selection of the points to be meshed.

The GSD is the side of the surface patch that one pixel covers, range x pixel angle / sqrt(cos of incidence); view
selection for textures uses the same measure. Import lazily: loads numba.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numba import njit, prange

from scan2sim.pipeline.camera.depth_map import depth_map, scene
from scan2sim.pipeline.camera.projection import (
    PosedCamera,
    Ranges,
    incidence,
    is_visible,
    pixel_of,
    posed_camera,
    rotate_to_camera,
    to_camera,
)
from scan2sim.pipeline.core.step import Report, silent
from scan2sim.pipeline.core.types import F32, F64, Bools, PointCloud, View

MAX_PIXELS = 300_000
"""Maximum number of pixels of a range image; enough for discs of some decimetres."""
MIN_COS_INCIDENCE = 0.02
"""Lower limit of the cosine of incidence; no photo textures steeper surfaces (`texturing.view_selection.step`)."""


def finest_gsd(
    cloud: PointCloud, views: Sequence[View], *, voxel: float, max_gsd: float, report: Report = silent
) -> F32:
    """Finest ground sample distance (N,) of each point in any photo, metres; inf where no photo sees the point.

    Args:
        cloud: cloud with normals, thinned to about one point per voxel; it is also the occluder.
        views: perspective photos.
        voxel: voxel size in metres: radius of the occluding discs and tolerance behind them.
        max_gsd: coarser values (metres) are not needed and may be returned as inf.
        report: progress callback.
    """
    occluders = scene([], cloud, radius=0.8 * voxel)
    gsd = np.full(len(cloud), np.inf, np.float32)
    assert cloud.normal is not None
    for i, view in enumerate(views):
        report(i / len(views), view.name)
        depth = depth_map(view.camera, view.T_world_cam, occluders, time=view.time, pixels=MAX_PIXELS)
        camera = posed_camera(view.camera, view.T_world_cam)
        _refine(gsd, cloud.xyz, cloud.normal, camera, depth.ranges, voxel, max_gsd)
    return gsd


@njit(cache=True, parallel=True)
def _refine(gsd: F32, xyz: F32, normals: F32, camera: PosedCamera, ranges: Ranges, bias: float, max_gsd: float) -> None:
    """Lower `gsd` in place to the ground sample distance in one photo, for the points that it sees."""
    for i in prange(len(gsd)):
        x, y, z = to_camera(camera.T, xyz[i, 0], xyz[i, 1], xyz[i, 2])
        r = math.sqrt(x * x + y * y + z * z)
        if camera.pixel * r >= min(max_gsd, gsd[i]) or r < 1e-3:
            continue
        u, v, ok = pixel_of(camera, x, y, z)
        if not ok:
            continue
        nx, ny, nz = rotate_to_camera(camera.T, normals[i, 0], normals[i, 1], normals[i, 2])
        r, cos = incidence(camera, x, y, z, nx, ny, nz)
        side = camera.pixel * r / math.sqrt(max(abs(cos), MIN_COS_INCIDENCE))
        if side < gsd[i] and is_visible(camera, ranges, u, v, r, cos, bias):
            gsd[i] = side


def dilate_selection(xyz: F32, selected: Bools, distance: float) -> Bools:
    """(N,) bool, True for points that are selected or within `distance` metres of a selected point."""
    from scipy.spatial import cKDTree

    out = selected.copy()
    if selected.any():
        rest = np.flatnonzero(~selected)
        nearest, _ = cKDTree(xyz[selected]).query(xyz[rest], distance_upper_bound=distance, workers=-1)
        out[rest[np.isfinite(nearest)]] = True
    return out


def near_path(xyz: F32, path: F64, distance: float) -> Bools:
    """(N,) bool, True for points within `distance` metres of the path (M, 3), a polyline, in plan view."""
    from scipy.spatial import cKDTree

    from scan2sim.pipeline.geometry.path_sampling import resample_path

    nearest, _ = cKDTree(resample_path(path[:, :2])).query(xyz[:, :2], distance_upper_bound=distance, workers=-1)
    return np.isfinite(nearest)


def close_selection(xyz: F32, selected: Bools, cell: float, gap: float) -> Bools:
    """Morphological closing of a selection (N,) in plan view.

    Selects all points in grid cells of `cell` metres that hold a selected point, and fills holes and bays up to `gap`
    metres wide.
    """
    from scipy import ndimage

    if not selected.any():
        return selected
    radius = max(1, round(gap / 2 / cell))
    index = np.floor((xyz[:, :2] - xyz[:, :2].min(axis=0)) / cell).astype(np.int64) + radius
    grid = np.zeros(index.max(axis=0) + radius + 1, bool)
    grid[tuple(index[selected].T)] = True
    disc = np.hypot(*np.mgrid[-radius : radius + 1, -radius : radius + 1]) <= radius + 0.5
    return np.asarray(ndimage.binary_closing(grid, disc)[tuple(index.T)])
