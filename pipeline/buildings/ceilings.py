"""Ceilings of a storey as level polygons of few triangles, seen from both sides."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scan2sim.pipeline.buildings.storeys import Level
from scan2sim.pipeline.buildings.wall_slabs import rectangles
from scan2sim.pipeline.core.types import F32, F64, I32, I64

CELL_M = 0.3
CLOSED_CELLS = 3
"""Gaps in plan view up to twice this number of cells are closed."""
THICKNESS_M = 0.05


def ceiling_mesh(points: F32, everything: F32, levels: Sequence[Level], spacing: float) -> tuple[F32, I32]:
    """Vertices and faces of the ceilings of a storey.

    The sensor sees a ceiling in parts only: every part of the plan with any points is covered, at the height of the
    nearest points of a ceiling.

    Args:
        points: (N, 3) ceiling points.
        everything: (M, 3) all points of the storey.
        levels: its ceilings.
        spacing: typical distance of neighbouring points, metres.
    """
    from scipy import ndimage

    none = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)
    if not levels or len(points) < 10:
        return none
    cell = max(CELL_M, 3 * spacing)
    turn = _main_direction(everything)
    plan = everything[:, :2].astype(np.float64) @ turn
    low = np.percentile(plan, 0.5, axis=0) - cell / 2
    shape = np.ceil((np.percentile(plan, 99.5, axis=0) - low) / cell).astype(int) + 1

    def raster(xy: F64) -> np.ndarray:
        i = np.floor((xy - low) / cell).astype(int)
        i = i[((i >= 0) & (i < shape)).all(axis=1)]
        count = np.zeros(shape)
        np.add.at(count, tuple(i.T), 1)
        return count

    every = raster(plan)
    pad = CLOSED_CELLS + 1
    mask = np.pad(every > 0, pad)
    square = np.ones((3, 3))
    mask = ndimage.binary_closing(mask, square, iterations=CLOSED_CELLS)
    mask = ndimage.binary_opening(ndimage.binary_fill_holes(mask), square, iterations=2)[pad:-pad, pad:-pad]
    at = np.array([raster(points[np.abs(level.height(points)) < level.tolerance, :2] @ turn) for level in levels])
    seen = at.max(axis=0) > 0
    if not seen.any():
        return none
    which = np.where(seen, at.argmax(axis=0), -1)
    nearest = ndimage.distance_transform_edt(~seen, return_distances=False, return_indices=True)
    which = which[tuple(nearest)]
    if len(levels) > 1:
        which = ndimage.median_filter(which, 5)
    vertices: list[F64] = []
    faces: list[I64] = []
    for k, level in enumerate(levels):
        for i0, i1, j0, j1 in rectangles(mask & (which == k)):
            corners = low + cell * np.array([(i0, j0), (i1, j0), (i1, j1), (i0, j1)])
            xy = corners @ turn.T
            z = xy @ level.plane[:2] + level.plane[2]
            n = 8 * len(faces)
            vertices += [np.column_stack([xy, z]), np.column_stack([xy, z + THICKNESS_M])]
            faces.append(n + np.array([[0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7]]))
    if not faces:
        return none
    return np.concatenate(vertices).astype(np.float32), np.concatenate(faces).astype(np.int32)


def _main_direction(xyz: F32) -> F64:
    """(2, 2) rotation to the axes of the smallest rectangle around the plan, by columns."""
    some = xyz[:: max(1, len(xyz) // 5000), :2].astype(np.float64)
    best, chosen = np.inf, np.eye(2)
    for heading in np.radians(np.arange(0, 90, 1.0)):
        c, s = np.cos(heading), np.sin(heading)
        R = np.array([[c, -s], [s, c]])
        low, high = np.percentile(some @ R, (2, 98), axis=0)
        area = float(np.prod(high - low))
        if area < best:
            best, chosen = area, R
    return chosen
