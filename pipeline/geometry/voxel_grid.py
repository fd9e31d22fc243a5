"""Voxel grid: points grouped by voxel, and one sample or point per voxel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F32, I64, PointCloud

Groups = tuple[I64, I64]


def sample(cloud: PointCloud, size: float, groups: Groups | None = None) -> PointCloud:
    """One point per voxel of `size` metres: mean position and colour; class, intensity and time of one member.

    `groups` are its `voxel_groups`, if they were computed before.
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
    from scan2sim.pipeline.geometry.sorting import first_of_each, stable_argsort

    code = np.zeros(len(xyz), np.int64)
    for axis, shift in ((2, 0.5), (1, 0.0), (0, 0.0)):
        # the epsilon assigns points on the face between two voxels to the same one for any origin
        cell = np.floor(xyz[:, axis].astype(np.float64) / size + shift + 1e-6).astype(np.int64)
        cell -= cell.min()
        code = code * (cell.max() + 1) + cell
    order, code = stable_argsort(code)
    starts = np.flatnonzero(first_of_each(code))
    return order, starts


def thin_voxels(xyz: F32, size: float, rank: npt.NDArray[np.floating]) -> npt.NDArray[np.intp]:
    """Indices of one point per voxel of `size` metres: the one with the smallest `rank` (N,)."""
    order = np.argsort(rank, kind="stable")
    cells = np.floor(xyz[order] / size).astype(np.int64)
    cells -= cells.min(axis=0)
    _, first = np.unique(np.ravel_multi_index(tuple(cells.T), tuple(cells.max(axis=0) + 1)), return_index=True)
    return order[first]
