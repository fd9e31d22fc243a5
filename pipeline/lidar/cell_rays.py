"""Rays of a scanner in cells of space: which rays reach a cell. Import late: it loads numba."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from scan2sim.pipeline.core.types import F64, I32, I64

BLOCK_BITS = 3
"""Cells are looked up in blocks of 8 x 8 x 8; only those that contain a cell take memory."""


@dataclass(frozen=True)
class Cells:
    """Cubes of space that contain points, on a grid through the origin of the local frame.

    Attributes:
        size: length of an edge, metres.
        index: (C, 3) column, row and layer of each cell.
        of_point: (N,) cell of each point.
    """

    size: float
    index: I64
    of_point: I64

    def __len__(self) -> int:
        return len(self.index)

    @staticmethod
    def of(xyz: npt.NDArray[np.floating], size: float) -> Cells:
        """The cells of `size` metres that contain points (N, 3), local metres."""
        index, of_point = np.unique(np.floor(xyz / size).astype(np.int64), axis=0, return_inverse=True)
        return Cells(size, index.reshape(-1, 3), of_point.reshape(-1))

    def points(self) -> tuple[I64, I64]:
        """Index (C + 1,) of each cell's first point in a list of the points, cell after cell; and the list (N,)."""
        count = np.bincount(self.of_point, minlength=len(self))
        return np.append(0, np.cumsum(count)), np.argsort(self.of_point, kind="stable")


def trace(cells: Cells, origins: F64, returns: npt.NDArray[np.floating]) -> tuple[I64, I32]:
    """Rays in each of C cells: index (C + 1,) of each cell's first one in a list, cell after cell; and the list (M,).

    Args:
        cells: the cells.
        origins: (N, 3) positions of the scanner, local metres.
        returns: (N, 3) returns; a ray ends in the cell of its return.
    """
    low = cells.index.min(axis=0) >> BLOCK_BITS << BLOCK_BITS
    local, side = cells.index - low, 1 << BLOCK_BITS
    used, block = np.unique(local >> BLOCK_BITS, axis=0, return_inverse=True)
    blocks = np.full(used.max(axis=0) + 1, -1, np.int32)
    blocks[tuple(used.T)] = np.arange(len(used))
    table = np.full((len(used), side, side, side), -1, np.int32)
    table[(block.reshape(-1), *(local & (side - 1)).T)] = np.arange(len(cells))
    start, end = origins / cells.size - low, np.asarray(returns, np.float64) / cells.size - low
    crossed = np.zeros(len(cells), np.int64)
    _trace(start, end, blocks, table, np.zeros(0, np.int32), crossed)
    first = np.append(0, np.cumsum(crossed))
    ray = np.empty(first[-1], np.int32)
    _trace(start, end, blocks, table, ray, first[:-1].copy())
    return first, ray


@njit(cache=True)
def _trace(start: F64, end: F64, blocks: I32, table: I32, ray: I32, place: I64) -> None:
    """Walk along rays, in units of cells (Amanatides and Woo, "A fast voxel traversal algorithm", Eurographics 1987).

    Each crossing of cell c is written to `ray` (unless it is empty) at `place[c]`, which is then advanced.
    """
    mask = (1 << BLOCK_BITS) - 1
    cell, step = np.zeros(3, np.int64), np.zeros(3, np.int64)
    next_face, spacing, direction = np.zeros(3), np.zeros(3), np.zeros(3)
    for i in range(len(start)):
        length = math.sqrt(((end[i] - start[i]) ** 2).sum())
        if not length > 1e-9:  # NaN without a position
            continue
        enter, leave = 0.0, length
        for k in range(3):
            side = float(blocks.shape[k] << BLOCK_BITS)
            direction[k] = (end[i, k] - start[i, k]) / length
            if abs(direction[k]) < 1e-12:
                if start[i, k] < 0 or start[i, k] >= side:
                    leave = -1.0
                continue
            near, far = -start[i, k] / direction[k], (side - start[i, k]) / direction[k]
            enter, leave = max(enter, min(near, far)), min(leave, max(near, far))
        if enter >= leave:
            continue
        for k in range(3):
            position = math.floor(start[i, k] + direction[k] * enter)
            cell[k] = min(max(position, 0), (blocks.shape[k] << BLOCK_BITS) - 1)
            if abs(direction[k]) < 1e-12:
                step[k], spacing[k], next_face[k] = 0, np.inf, np.inf
            else:
                step[k] = 1 if direction[k] > 0 else -1
                spacing[k] = abs(1 / direction[k])
                next_face[k] = (cell[k] + (direction[k] > 0) - start[i, k]) / direction[k]
        at = enter
        while at < leave:
            axis = np.argmin(next_face)
            block = blocks[cell[0] >> BLOCK_BITS, cell[1] >> BLOCK_BITS, cell[2] >> BLOCK_BITS]
            found = table[block, cell[0] & mask, cell[1] & mask, cell[2] & mask] if block >= 0 else -1
            if found >= 0:
                if len(ray):
                    ray[place[found]] = i
                place[found] += 1
            at = next_face[axis]
            cell[axis] += step[axis]
            next_face[axis] += spacing[axis]
            if cell[axis] < 0 or cell[axis] >= blocks.shape[axis] << BLOCK_BITS:
                break
