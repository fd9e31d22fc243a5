"""Floor mesh: triangles over a height map, few where it is flat (greedy insertion, Garland and Heckbert 1995).

The Delaunay triangulation of selected cells is refined at the cell of the largest error of each triangle until every
cell is covered and within a tolerance. Neighbouring triangles share their vertices, so that there are no cracks.
"""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.types import F64, I64, Bools, Frame, Mesh
from scan2sim.pipeline.geometry.height_map import Raster

MAX_ROUNDS = 60
OUTLINE_TOLERANCE_CELLS = 1.0
"""Deviation up to which the outline is simplified before the refinement."""


def triangulate(raster: Raster, height: F64, tolerance: float, frame: Frame) -> Mesh:
    """Mesh of the cells that have a height, facing up.

    Args:
        raster: the cells.
        height: (rows, columns) metres, NaN where there is no surface.
        tolerance: maximum vertical distance of the mesh from the cells' heights, metres.
        frame: of the mesh.
    """
    from scipy.ndimage import binary_erosion
    from scipy.spatial import Delaunay

    from scan2sim.pipeline.terrain.triangle_raster_numba import rasterize_triangles

    there = _without_spurs(np.isfinite(height))
    cells = np.argwhere(there)
    if not len(cells):
        return Mesh(frame, np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    z = height[there]
    number = np.full(there.shape, -1)
    number[there] = np.arange(len(cells))
    inner = binary_erosion(there, np.ones((3, 3)))[there]  # the outermost cells may stay uncovered
    chosen = np.zeros(len(cells), bool)
    chosen[_outline(there, number)] = True
    for _ in range(MAX_ROUNDS):
        points = np.flatnonzero(chosen)
        faces = points[Delaunay(cells[points]).simplices]
        inside = _inside(cells, faces, there)
        own, found = rasterize_triangles(cells[faces], z[faces], there.shape)
        own, off = own[there], np.abs(found[there] - z)
        missing = ((own < 0) | ~inside[own]) & inner
        bad = ((off > tolerance) | missing) & ~chosen
        if not bad.any():
            break
        off = np.where(missing, np.inf, off)
        index = np.flatnonzero(bad)
        order = index[np.lexsort((-off[index], own[index]))]
        chosen[order[np.flatnonzero(np.diff(own[order], prepend=-2))]] = True
    faces = faces[inside]
    used, faces = np.unique(faces, return_inverse=True)
    faces = faces.reshape(-1, 3)
    xy = (cells[used][:, ::-1] + np.asarray(raster.low) + 0.5) * raster.cell
    a, b, c = (xy[faces[:, k]] for k in range(3))
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    faces = np.where((area < 0)[:, None], faces[:, [0, 2, 1]], faces)[area != 0]
    vertices = np.column_stack([xy, z[used]]).astype(np.float32)
    return Mesh(frame, vertices, faces.astype(np.int32)).keep(np.ones(len(faces), bool))


def _without_spurs(mask: Bools) -> Bools:
    """Cells that are in a square of 2 x 2 cells of the mask: others have no area."""
    square = mask[1:, 1:] & mask[:-1, 1:] & mask[1:, :-1] & mask[:-1, :-1]
    out = np.zeros(mask.shape, bool)
    for rows in (slice(1, None), slice(None, -1)):
        for columns in (slice(1, None), slice(None, -1)):
            out[rows, columns] |= square
    return out


def _outline(mask: Bools, number: I64) -> I64:
    """Cells at the corners of the simplified outlines."""
    import cv2

    outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    corners = [cv2.approxPolyDP(line, OUTLINE_TOLERANCE_CELLS, True).reshape(-1, 2) for line in outlines]
    corners += [np.column_stack([line[:, 0, 0], line[:, 0, 1]])[[0]] for line in outlines]
    columns, rows = np.concatenate(corners).T
    found = np.unique(number[rows, columns])
    found = found[found >= 0]
    r, c = np.nonzero(mask)  # the extreme cells make the triangulation possible
    ends = [number[r[i], c[i]] for key in (r, c, r + c, r - c) for i in (key.argmin(), key.argmax())]
    return np.unique(np.concatenate([found, ends]))


def _inside(cells: I64, faces: I64, mask: Bools) -> Bools:
    """Whether triangles lie in the mask: at points of them, outwards from the centre."""
    corners = cells[faces].astype(np.float64)
    centre = corners.mean(axis=1)
    hits = [_mask_at(mask, centre)]
    for k in range(3):
        hits.append(_mask_at(mask, (centre + corners[:, k]) / 2))
        hits.append(_mask_at(mask, (corners[:, k] + corners[:, (k + 1) % 3]) / 2 * 0.9 + 0.1 * centre))
    return np.asarray(np.mean(hits, axis=0) > 0.5, bool)


def _mask_at(mask: Bools, at: F64) -> Bools:
    """Mask at fractional cells (N, 2)."""
    row, column = np.rint(at).astype(np.int64).T
    return np.asarray(mask[row, column], bool)
