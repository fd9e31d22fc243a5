"""Assumed heights of a floor where no point shows it: from its surroundings, feet of walls and the sensor's path."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.types import F32, F64, Bools
from scan2sim.pipeline.geometry.height_map import Raster, close_gaps, dilate, fill_membrane
from scan2sim.pipeline.terrain.floor_limits import LIMITS, Storey


def filtered_floor(raster: Raster, nodes: F64, foot: F64, path: F32 | None) -> tuple[F64, float | None]:
    """Heights (rows, columns) of a floor that was not scanned at feet of walls and below the path, and sensor height.

    Low feet of each square metre are smoothed: furniture and the limits of the scanner's view hide others.
    """
    from scipy.spatial import cKDTree

    there = np.isfinite(foot)
    xyz = np.concatenate([np.column_stack([raster.centres(there), foot[there]]), nodes])
    if not len(xyz):
        return np.full(raster.shape, np.nan), None
    blocks = _block_percentiles(xyz, LIMITS.foot_block, LIMITS.foot_percentile)
    plane, weight = np.array([0.0, 0.0, float(np.median(blocks[:, 2]))]), np.ones(len(blocks))
    A = np.column_stack([blocks[:, :2], np.ones(len(blocks))])
    off = blocks[:, 2] - plane[2]
    for _ in range(10 if len(blocks) >= 6 else 0):
        fitted = np.linalg.lstsq(A * weight[:, None], blocks[:, 2] * weight, rcond=1e-6)[0]
        if np.hypot(*fitted[:2]) > LIMITS.slope:
            break
        plane, off = fitted, blocks[:, 2] - A @ fitted
        sigma = max(0.05, 1.4826 * float(np.median(np.abs(off))))
        weight = np.sqrt(1 / np.maximum(1, np.where(off > 0, 2, 1) * np.abs(off) / sigma))
    off = blocks[:, 2] - A @ plane
    sound = np.abs(off) < 2 * LIMITS.step
    blocks, off = blocks[sound], off[sound]
    if not len(blocks):
        blocks, off = xyz[:1], np.zeros(1)
    distance = np.linalg.norm(blocks[:, None, :2] - blocks[None, :, :2], axis=2) if len(blocks) <= 4000 else None
    if distance is not None:
        kernel = np.exp(-0.5 * (distance / LIMITS.foot_smoothing) ** 2)
        off = kernel @ off / kernel.sum(axis=1)
    values = np.column_stack([blocks[:, :2], A[sound] @ plane + off]) if sound.any() else blocks
    sensor_height = None
    if path is not None and len(path):
        far, near = cKDTree(values[:, :2]).query(path[:, :2])
        above = path[:, 2] - values[near, 2]
        above = above[far < LIMITS.foot_radius]
        above = above[(above > LIMITS.sensor_height[0]) & (above < LIMITS.sensor_height[1])]
        if len(above):
            sensor_height = float(np.percentile(above, 75))
            below = np.column_stack([path[:, :2], path[:, 2] - sensor_height])
            values = values[cKDTree(below[:, :2]).query(values[:, :2])[0] > LIMITS.foot_radius]
            values = np.concatenate([values, _block_percentiles(below, LIMITS.foot_block, 50.0)])
    feet = np.full(raster.shape, np.nan)
    feet[raster.at(values)] = values[:, 2]
    return feet, sensor_height


def complete(
    raster: Raster,
    scanned: F64,
    feet: F64,
    standing: F32,
    path: F32 | None,
    gap: float,
    openings: Bools | None = None,
    stairs: Bools | None = None,
    *,
    within_walls: bool = False,
) -> Storey:
    """The floor of a storey: scanned heights (rows, columns), and a membrane where the floor is assumed.

    Args:
        raster: the cells.
        scanned: measured heights, NaN elsewhere.
        feet: heights that are known less well: of the feet of walls, and below the sensor's path; NaN elsewhere.
        standing: (N, 3) points that may stand on the floor.
        path: (K, 3) positions of the sensor, or None.
        gap: gaps narrower than twice this are closed, metres.
        openings: cells that stay open, or None.
        stairs: cells that do not determine the assumed heights around them, or None.
        within_walls: whether an assumed floor ends at walls: behind them it was neither scanned nor walked on.
    """
    from scipy import ndimage

    cell = raster.cell
    measured = np.isfinite(scanned)
    clear = ~dilate(measured, LIMITS.foot_clearance / cell)
    known = np.where(measured, scanned, np.where(clear, feet, np.nan))
    if not np.isfinite(known).any():
        return Storey(known, measured)
    base = known if stairs is None or not np.isfinite(known[~stairs]).any() else np.where(stairs, np.nan, known)
    around = nearest_heights(base)
    above = standing[:, 2] - around[raster.at(standing)] if len(standing) else np.zeros(0)
    obstacles = standing[(above > -LIMITS.step) & (above < LIMITS.obstacle)]
    on_path = dilate(raster.covered(path), LIMITS.path_radius / cell) if path is not None and len(path) else False
    covered = measured | on_path | (raster.covered(obstacles) if len(obstacles) else False)
    wanted = ndimage.binary_fill_holes(close_gaps(covered, gap / cell))
    wall = np.zeros(raster.shape, bool)
    if within_walls and len(standing):
        high = (above > LIMITS.wall_height) & (above < LIMITS.obstacle)
        wall = close_gaps(raster.covered(standing[high]), 1.5) if high.any() else wall
        wanted = _without_outside(wanted, wall, measured | on_path)
    part, count = ndimage.label(wanted, np.ones((3, 3)))
    area = np.bincount(part[np.isfinite(known) & wanted], minlength=count + 1)
    area[0] = 0
    wanted &= (area >= 0.02 * area.max())[part]
    wanted |= dilate(wanted & ~wall, 1.5)
    if openings is not None:
        wanted &= ~openings | measured
    base = np.where(wanted, base, np.nan)
    height = _membrane(base, wanted & ~(measured & ~np.isfinite(base)))
    height = np.where(measured & wanted, scanned, height)
    rest = wanted & ~np.isfinite(height)
    height[rest] = around[rest]
    near = ndimage.distance_transform_edt(~measured) * cell <= LIMITS.scanned_radius if measured.any() else measured
    return Storey(np.where(wanted, height, np.nan), near & wanted)


def _without_outside(wanted: Bools, wall: Bools, known: Bools) -> Bools:
    """Cells of a floor without the parts behind its walls: those without a known cell, and open where walls end."""
    from scipy import ndimage

    part, count = ndimage.label(wanted & ~wall)
    inside = ndimage.binary_erosion(part > 0)
    edge, open_edge = (
        np.bincount(part[mask], minlength=count + 1)
        for mask in (~inside & (part > 0), ndimage.binary_dilation(~wanted) & (part > 0))
    )
    outside = open_edge > LIMITS.outside_open_share * edge
    outside[np.bincount(part.ravel())[1:].argmax() + 1 if count else 0] = False
    outside[part[known]] = False
    return wanted & ~outside[part]


def nearest_heights(height: F64) -> F64:
    """Heights with NaN replaced by the nearest height."""
    from scipy import ndimage

    index = ndimage.distance_transform_edt(~np.isfinite(height), return_distances=False, return_indices=True)
    return np.asarray(height[tuple(index)], np.float64)


def near_floor(foot: F64, around: F64) -> F64:
    """Feet of walls that are at the height of the floor around; NaN elsewhere: something hides the others' feet."""
    with np.errstate(invalid="ignore"):
        return np.where(np.abs(foot - around) < LIMITS.step / 2, foot, np.nan)


def median_sensor_height(raster: Raster, path: F32, scanned: F64, around: F64) -> float | None:
    """Height of the sensor over scanned ground within a metre below it; None if there is none."""
    from scipy import ndimage

    if not len(path):
        return None
    near = ndimage.distance_transform_edt(~np.isfinite(scanned))[raster.at(path)] * raster.cell < 1.0
    height = (path[:, 2] - around[raster.at(path)])[near]
    low, high = LIMITS.sensor_height
    height = height[(height > low) & (height < high)]
    return float(np.median(height)) if len(height) else None


def _block_percentiles(xyz: F64, block: float, percentile: float) -> F64:
    """Mean positions and a percentile of the heights (K, 3) of the points (N, 3) in each square of size `block`."""
    square = np.floor(xyz[:, :2] / block).astype(np.int64)
    _, index = np.unique(square, axis=0, return_inverse=True)
    index = index.ravel()
    order = np.lexsort((xyz[:, 2], index))
    first = np.flatnonzero(np.diff(index[order], prepend=-1))
    count = np.diff(np.append(first, len(order)))
    z = xyz[order[first + (percentile / 100 * (count - 1)).astype(np.int64)], 2]
    mean = np.add.reduceat(xyz[order, :2], first) / count[:, None]
    return np.column_stack([mean, z])


def _membrane(known: F64, wanted: Bools) -> F64:
    """`fill_membrane` of one layer, on larger cells if there are many."""
    missing = wanted & ~np.isfinite(known)
    factor = int(np.ceil(np.sqrt(missing.sum() / LIMITS.membrane_cells)))
    if factor <= 1:
        return fill_membrane(known[..., None], wanted)[..., 0]
    rows, columns = (-(-n // factor) for n in known.shape)
    pad = ((0, rows * factor - known.shape[0]), (0, columns * factor - known.shape[1]))
    blocks = np.pad(known, pad, constant_values=np.nan).reshape(rows, factor, columns, factor)
    count = np.isfinite(blocks).sum(axis=(1, 3))
    mean = np.where(count > 0, np.nansum(blocks, axis=(1, 3)) / np.maximum(count, 1), np.nan)
    coarse: Bools = np.any(np.pad(wanted, pad).reshape(rows, factor, columns, factor), axis=(1, 3))
    filled = nearest_heights(fill_membrane(mean[..., None], coarse)[..., 0])
    r, c = ((np.arange(n) + 0.5) / factor - 0.5 for n in known.shape)
    out = known.copy()
    out[missing] = _bilinear(filled, r, c)[missing]
    return out


def _bilinear(values: F64, rows: F64, columns: F64) -> F64:
    """Values at all pairs of fractional rows and columns."""
    r, c = rows.clip(0, values.shape[0] - 1), columns.clip(0, values.shape[1] - 1)
    i, j = r.astype(int), c.astype(int)
    u, v = (r - i)[:, None], (c - j)[None]
    i2, j2 = np.minimum(i + 1, values.shape[0] - 1), np.minimum(j + 1, values.shape[1] - 1)
    top = values[np.ix_(i, j)] * (1 - v) + values[np.ix_(i, j2)] * v
    bottom = values[np.ix_(i2, j)] * (1 - v) + values[np.ix_(i2, j2)] * v
    return np.asarray(top * (1 - u) + bottom * u, np.float64)
