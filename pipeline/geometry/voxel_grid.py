"""Voxel grid: points grouped by voxel or sheet, and one sample or point per group."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F32, F64, I64, PointCloud

Groups = tuple[I64, I64]

MAX_SHEET_SEPARATION = 0.3
"""Distance in voxels of the means of adjacent voxels, across their shared face, up to which they may hold one sheet."""
MAX_SHEET_FLATNESS = 0.5
"""Standard deviation of a sheet's points across the face over that along it: a slope of 27 degrees, or noise of a
seventh of a voxel."""


def sample(cloud: PointCloud, size: float, groups: Groups | None = None) -> PointCloud:
    """One point per voxel of `size` metres: mean position and colour; class, intensity and time of one member.

    `groups` are other groups of points, such as `sheet_groups`, or its `voxel_groups`, if they were computed before.
    Means are rounded to `pipeline.geometry.coordinate_grid.GRID_M`: tiles with the same points around their border,
    in the same order (`overlap`), get the same samples there.
    """
    from scan2sim.pipeline.geometry.coordinate_grid import snap_to_grid

    if len(cloud) == 0:
        return cloud
    order, starts = groups or voxel_groups(cloud.xyz, size)
    counts = np.diff(np.append(starts, len(order)))
    first = order[starts]

    def mean(values: np.ndarray, weight: np.ndarray | None = None) -> np.ndarray:
        weighted = values if weight is None else values * weight[:, None]
        total = np.stack([np.add.reduceat(column[order].astype(np.float64), starts) for column in weighted.T], axis=1)
        return total / (counts if weight is None else np.add.reduceat(weight[order], starts))[:, None]

    thin = cloud.take(first)
    thin = replace(thin, xyz=snap_to_grid(mean(cloud.xyz)).astype(np.float32), normal=None)
    if cloud.rgb is not None:
        known = cloud.coloured  # uncoloured points must not affect the mean
        weight = None if known.all() else np.where(known, 1.0, 1e-9)
        thin = replace(thin, rgb=np.rint(mean(cloud.rgb, weight)).astype(np.uint8))
    return thin


def voxel_groups(xyz: F32, size: float) -> Groups:
    """Points sorted by voxel, and the start of each voxel in that order.

    Voxels are aligned to multiples of `size`, in height with an offset of half a voxel (so that a level floor at a
    round height isn't split). Origins of tiles are whole metres, so voxels agree if a metre is a multiple of `size`.

    Returns:
        order (N,) int64 into `xyz`, stable within a voxel; starts (V,) int64 into `order`.
    """
    return _sorted_by_voxel(xyz, size)[0]


def sheet_groups(xyz: F32, size: float) -> Groups:
    """Points grouped by voxel like `voxel_groups`; two voxels with a thin sheet in their shared face are one group.

    A flat wall in the face between two layers of voxels thus gets one layer of samples, as it does anywhere else. Of
    the pairs of a voxel, the flattest is joined if it is the flattest of the other voxel, too: only points up to two
    voxels away matter, so that tiles with the same points around their border get the same groups there.
    """
    if len(xyz) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    (order, starts), code, strides = _sorted_by_voxel(xyz, size)
    count = np.diff(np.append(starts, len(order)))
    first, mean, variance = _moments(xyz, order, starts, count)
    pairs, flatness = [], []
    for axis, stride in enumerate(strides):
        upper = np.minimum(np.searchsorted(code, code + stride), len(code) - 1)
        a = np.flatnonzero(code[upper] == code + stride)
        a = a[_separation(first[axis], mean[axis], a, upper[a]) < MAX_SHEET_SEPARATION * size]
        b = upper[a]
        share = count[b] / (count[a] + count[b])
        spread = np.stack(
            [
                (1 - share) * v[a] + share * v[b] + share * (1 - share) * _separation(f, m, a, b) ** 2
                for f, m, v in zip(first, mean, variance, strict=True)
            ]
        )
        across, along = spread[axis], np.delete(spread, axis, axis=0).max(axis=0)
        sheet = across < MAX_SHEET_FLATNESS**2 * along
        pairs.append(np.column_stack([a, b])[sheet])
        flatness.append(across[sheet] / along[sheet])
    pair = np.concatenate(pairs)[np.argsort(np.concatenate(flatness), kind="stable")]
    rank, best = np.arange(len(pair)), np.full(len(code), len(pair))
    np.minimum.at(best, pair, rank[:, None])
    return _joined(order, starts, count, pair[(best[pair] == rank[:, None]).all(axis=1)])


def _moments(xyz: F32, order: I64, starts: I64, count: I64) -> tuple[F64, F64, F64]:
    """First point (3, V) of each group, and mean (3, V), relative to it, and variance (3, V) of its points.

    Relative to a point of the group, the sums of rounded coordinates (`overlap`) are exact, hence equal in all tiles.
    """
    first, mean, square = np.empty((3, 3, len(starts)))
    for axis in range(3):
        column = xyz[order, axis].astype(np.float64)
        first[axis] = column[starts]
        column -= np.repeat(first[axis], count)
        mean[axis] = np.add.reduceat(column, starts) / count
        square[axis] = np.add.reduceat(column**2, starts) / count
    return first, mean, square - mean**2


def _separation(first: F64, mean: F64, a: I64, b: I64) -> F64:
    """Coordinate (P,) of the means of groups b minus that of groups a, from those (V,) of `_moments` on one axis."""
    return np.asarray(first[b] - first[a] + (mean[b] - mean[a]))


def _joined(order: I64, starts: I64, count: I64, pairs: I64) -> Groups:
    """Groups in which the second group of each pair (P, 2) follows the first one as its part."""
    leader = np.arange(len(starts))
    leader[pairs[:, 1]] = pairs[:, 0]
    by_leader = np.argsort(leader, kind="stable")
    starts, count = starts[by_leader], count[by_leader]
    new_starts = np.cumsum(count) - count
    order = order[np.repeat(starts - new_starts, count) + np.arange(len(order))]
    return order, new_starts[leader[by_leader] == by_leader]


def _sorted_by_voxel(xyz: F32, size: float) -> tuple[Groups, I64, tuple[int, int, int]]:
    """`voxel_groups`, the sorted codes (V,) of their voxels, and the differences of codes of neighbours in x, y, z."""
    from scan2sim.pipeline.geometry.sorting import first_of_each, stable_argsort

    code, strides = np.zeros(len(xyz), np.int64), [1, 1, 1]
    for axis, shift in ((2, 0.5), (1, 0.0), (0, 0.0)):
        # the epsilon assigns points on the face between two voxels to the same one for any origin
        cell = np.floor(xyz[:, axis].astype(np.float64) / size + shift + 1e-6).astype(np.int64)
        cell -= cell.min()
        extent = int(cell.max()) + 2  # one cell remains empty: the last one of a row has no neighbour in the next row
        code = code * extent + cell
        strides[axis + 1 :] = [stride * extent for stride in strides[axis + 1 :]]
    order, code = stable_argsort(code)
    starts = np.flatnonzero(first_of_each(code))
    return (order, starts), code[starts], (strides[0], strides[1], strides[2])


def thin_voxels(xyz: F32, size: float, rank: npt.NDArray[np.floating]) -> npt.NDArray[np.intp]:
    """Indices of one point per voxel of `size` metres: the one with the smallest `rank` (N,)."""
    order = np.argsort(rank, kind="stable")
    cells = np.floor(xyz[order] / size).astype(np.int64)
    cells -= cells.min(axis=0)
    _, first = np.unique(np.ravel_multi_index(tuple(cells.T), tuple(cells.max(axis=0) + 1)), return_index=True)
    return order[first]
