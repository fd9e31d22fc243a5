"""Measured heights of a storey's floor: without furniture and spikes, denoised, on planes where it is flat."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.types import F64, Bools
from scan2sim.pipeline.geometry.height_map import Raster, close_gaps
from scan2sim.pipeline.terrain.floor_limits import LIMITS


def scanned_heights(raster: Raster, nodes: F64, level: bool) -> F64:
    """Measured heights (rows, columns) of one storey, without furniture and spikes, denoised; NaN elsewhere."""
    height = np.full(raster.shape, np.nan)
    if not len(nodes):
        return height
    nodes = nodes[_connected(nodes, raster.cell)]
    nodes = nodes[np.argsort(nodes[:, 2], kind="stable")]
    height[raster.at(nodes)] = nodes[:, 2]  # the highest of a column is assigned last
    there = np.isfinite(height)
    xyz = np.column_stack([raster.centres(there), height[there]])
    keep = _supported(xyz, raster.cell)
    xyz = xyz[keep]
    z, noise, support = _denoised(xyz, raster.cell)
    xyz, z = xyz[support >= LIMITS.min_support], z[support >= LIMITS.min_support]
    if level:
        tolerance = float(np.clip(3 * noise, *LIMITS.plane_tolerance))
        z = _snapped(np.column_stack([xyz[:, :2], z]), tolerance, raster)
    height[:] = np.nan
    height[raster.at(xyz)] = z
    radius = LIMITS.noise_smoothing * (noise - LIMITS.fine_noise) / raster.cell
    return height if radius < 1 else _averaged(height, radius)


def _averaged(height: F64, sigma: float) -> F64:
    """Heights averaged with a Gaussian of `sigma` cells over those that exist."""
    from scipy import ndimage

    there = np.isfinite(height)
    total = ndimage.gaussian_filter(np.where(there, height, 0.0), sigma, mode="constant")
    weight = ndimage.gaussian_filter(there.astype(np.float64), sigma, mode="constant")
    return np.where(there, total / np.maximum(weight, 1e-9), np.nan)


def _connected(nodes: F64, cell: float) -> Bools:
    """Whether each height (N, 3) is part of the floor, not of furniture, a wall or noise."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    reach = max(LIMITS.neighbour_radius, 2.5 * cell)
    scale = np.array([reach, reach, LIMITS.step])
    k = min(len(nodes), 32)
    distance, near = cKDTree(nodes / scale).query(nodes / scale, k=k, p=np.inf, distance_upper_bound=1.0, workers=-1)
    row = np.repeat(np.arange(len(nodes)), k)[np.isfinite(distance).ravel()]
    column = near.ravel()[np.isfinite(distance).ravel()]
    graph = coo_matrix((np.ones(len(row), np.int8), (row, column)), (len(nodes), len(nodes)))
    part = connected_components(graph, directed=False)[1]
    area = np.bincount(part) * cell**2
    accepted = area[part] >= max(0.25 * area.max(), LIMITS.max_furniture)
    if not accepted.any():
        accepted = area[part] == area.max()
    # parts grow from the accepted ones outwards; each round accepts those that fit their surroundings
    for _ in range(8):
        rest = np.flatnonzero(~accepted)
        if not len(rest):
            break
        tree = cKDTree(nodes[accepted, :2])
        far, index = tree.query(nodes[rest, :2], k=min(8, int(accepted.sum())), workers=-1)
        far, index = far.reshape(len(rest), -1), index.reshape(len(rest), -1)
        around = np.median(nodes[accepted, 2][index], axis=1)
        fits = np.abs(nodes[rest, 2] - around) < LIMITS.step / 2 + LIMITS.slope * far[:, 0]
        share = np.bincount(part[rest], weights=fits) / np.maximum(np.bincount(part[rest]), 1)
        new = share[part[rest]] > 0.5
        if not new.any():
            break
        accepted[rest[new]] = True
    return np.asarray(accepted, bool)


def _supported(xyz: F64, cell: float) -> Bools:
    """Whether heights (N, 3) are supported by neighbours: spikes and pits are not."""
    from scipy.spatial import cKDTree

    k = min(len(xyz), 25)
    far, near = cKDTree(xyz[:, :2]).query(xyz[:, :2], k=k, workers=-1)
    far, near = far.reshape(len(xyz), k), near.reshape(len(xyz), k)
    close = far < 4.5 * cell
    off = np.abs(xyz[near, 2] - xyz[:, 2:]) < LIMITS.support + LIMITS.slope / 2 * far
    support, count = (close & off).sum(axis=1), close.sum(axis=1)
    enough = count >= LIMITS.isolated_share * np.median(count)  # a lonely height in a hole of the floor is noise
    return np.asarray(enough & (support >= np.minimum(5, count)) & (support > 0.25 * count), bool)


def _denoised(xyz: F64, cell: float) -> tuple[F64, float, F64]:
    """Bilateral filter of heights (N, 3), which keeps steps.

    Returns:
        Heights (N,), their noise before, and the share (N,) of neighbours on the same side of steps.
    """
    from scipy.spatial import cKDTree

    radius = max(LIMITS.smoothing, 2.5 * cell)
    k = min(len(xyz), 48)
    far, near = cKDTree(xyz[:, :2]).query(xyz[:, :2], k=k, workers=-1)
    far, near = far.reshape(len(xyz), k), near.reshape(len(xyz), k)
    z = xyz[:, 2].copy()
    noise = 1.4826 * float(np.median(np.abs(z - np.median(z[near], axis=1))))
    cut = float(np.clip(3 * noise, 0.05, 0.15))
    plain = np.exp(-0.5 * (far / radius * 2) ** 2) * (far <= radius)
    for _ in range(3):
        off = z[near] - z[:, None]
        weight = plain * np.maximum(0, 1 - (off / cut) ** 2) ** 2
        z = z + (weight * off).sum(axis=1) / weight.sum(axis=1)
    support = ((weight > 0).sum(axis=1) - 1) / np.maximum((plain > 0).sum(axis=1) - 1, 1)
    return z, noise, np.where((plain > 0).sum(axis=1) > 1, support, 1.0)


def _snapped(xyz: F64, tolerance: float, raster: Raster) -> F64:
    """Heights (N,) on the largest planes through the heights (N, 3), where they are within the tolerance of one."""
    from scipy import ndimage

    z, free, planes = xyz[:, 2].copy(), np.ones(len(xyz), bool), np.zeros((len(xyz), 3))
    rng = np.random.default_rng(0)
    for _ in range(12):
        index = np.flatnonzero(free)
        if len(index) * raster.cell**2 < LIMITS.min_plane:
            break
        plane = _level_plane(xyz[index], tolerance, rng)
        near = free & (np.abs(plane[0] * xyz[:, 0] + plane[1] * xyz[:, 1] + plane[2] - xyz[:, 2]) < tolerance)
        cells = np.zeros(raster.shape, bool)
        cells[raster.at(xyz[near])] = True
        part, count = ndimage.label(close_gaps(cells, 2.0), np.ones((3, 3)))
        mine = part[raster.at(xyz)]
        area = np.bincount(mine[near], minlength=count + 1) * raster.cell**2
        on = near & (area[mine] >= LIMITS.min_plane)
        if not on.any():
            break
        z[on] = plane[0] * xyz[on, 0] + plane[1] * xyz[on, 1] + plane[2]
        free &= ~on
        planes[on] = plane
    return _snapped_noise(xyz, z, free, planes, raster)


def _snapped_noise(xyz: F64, z: F64, free: Bools, planes: F64, raster: Raster) -> F64:
    """Heights (N,); small groups close to a plane (N, 3) beside them are noise and moved onto it."""
    from scipy import ndimage
    from scipy.spatial import cKDTree

    if free.all() or not free.any():
        return z
    cells = np.zeros(raster.shape, bool)
    cells[raster.at(xyz[free])] = True
    part, _ = ndimage.label(cells, np.ones((3, 3)))
    small = np.bincount(part.ravel())[part[raster.at(xyz)]] * raster.cell**2 < LIMITS.max_noise_area
    plane = planes[~free][cKDTree(xyz[~free, :2]).query(xyz[:, :2], workers=-1)[1]]
    on = (plane[:, :2] * xyz[:, :2]).sum(axis=1) + plane[:, 2]
    return np.where(free & small & (np.abs(on - z) < LIMITS.max_noise), on, z)


def _level_plane(xyz: F64, tolerance: float, rng: np.random.Generator) -> F64:
    """Plane z = a x + b y + c with the most heights (N, 3) within the tolerance (RANSAC, then least squares)."""
    best: F64 = np.zeros(3)
    most = -1
    some = xyz[rng.permutation(len(xyz))[:4000]]
    for _ in range(100):
        three = some[rng.integers(len(some), size=3)]
        A = np.column_stack([three[:, :2], np.ones(3)])
        if abs(np.linalg.det(A)) < 0.05:
            continue
        plane = np.asarray(np.linalg.solve(A, three[:, 2]))
        if np.hypot(plane[0], plane[1]) > LIMITS.slope:
            continue
        count = int((np.abs(some[:, :2] @ plane[:2] + plane[2] - some[:, 2]) < tolerance).sum())
        if count > most:
            best, most = plane, count
    if most < 0:
        best = np.array([0.0, 0.0, float(np.median(xyz[:, 2]))])
    for _ in range(3):
        on = np.abs(xyz[:, :2] @ best[:2] + best[2] - xyz[:, 2]) < tolerance
        if on.sum() >= 10:
            best = np.linalg.lstsq(np.column_stack([xyz[on, :2], np.ones(on.sum())]), xyz[on, 2], rcond=None)[0]
    return np.asarray(best, np.float64)
