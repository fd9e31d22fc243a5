"""Roof outlines: segmentation of roofs in a height raster, and their regularized outlines.

Sides are fitted to the contour of a mask and aligned to the building's main directions (Sampath and Shan, "Building
boundary tracing and regularization from airborne lidar point clouds", PE&RS 73, 2007).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from scan2sim.pipeline.core.types import F64, I64, Bools
from scan2sim.pipeline.geometry.height_map import Raster, close_gaps, signed_area

PIXELS_PER_CELL = 4  # of the image in which contours are traced
MAIN_DIRECTION_ROUNDS = 5
MAX_ALIGNMENT_RAD = np.radians(12.0)  # largest rotation of a side to a main direction
MIN_CORNER_RAD = np.radians(20.0)  # sides that differ by less are connected by a step instead of a corner
END_FRACTION = 0.15  # part of a side at each end, near corners, that is not used to fit its line
GAP_CELLS = 2  # gaps within one roof


@dataclass(frozen=True)
class OutlinePoints:
    """Points along the sides of rings.

    Attributes:
        xy: (N, 2) local metres.
        outward: (N, 2) unit vectors, away from the inside of the ring.
        side: (N,) number of the side, counted over all rings.
    """

    xy: F64
    outward: F64
    side: I64

    def __len__(self) -> int:
        return len(self.xy)

    @staticmethod
    def along(rings: list[F64], step: float) -> OutlinePoints:
        """Points at most `step` metres apart along rings (K, 2) with their inside to the left."""
        xy, outward, side = [np.zeros((0, 2))], [np.zeros((0, 2))], [np.zeros(0, np.int64)]
        count = 0
        for ring in rings:
            for start, end in pairwise(np.concatenate([ring, ring[:1]])):
                length = float(np.linalg.norm(end - start))
                if length < 1e-6:
                    continue
                n = max(1, int(np.ceil(length / step)))
                forward = (end - start) / length
                xy.append(start + ((np.arange(n) + 0.5) / n)[:, None] * (end - start))
                outward.append(np.tile([forward[1], -forward[0]], (n, 1)))
                side.append(np.full(n, count))
                count += 1
        return OutlinePoints(np.concatenate(xy), np.concatenate(outward), np.concatenate(side))


def roofs(top: F64, cell: float, step: float, min_area: float) -> I64:
    """Number of the roof of each cell, 0: none.

    Cells of one roof are connected without a height step above `step` metres. Components smaller than `min_area` m2
    (chimneys) belong to the roof around them, or to none.

    Args:
        top: (rows, columns) heights, NaN where there is no roof.
    """
    from scipy import ndimage
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    mask = close_gaps(np.isfinite(top), GAP_CELLS)
    if not mask.any():
        return np.zeros(top.shape, np.int64)
    height = nearest_value(top, np.isfinite(top))
    number = np.full(top.shape, -1)
    number[mask] = np.arange(int(mask.sum()))
    pairs = []
    for a, b in (((slice(None, -1), slice(None)), (slice(1, None), slice(None))),
                 ((slice(None), slice(None, -1)), (slice(None), slice(1, None)))):  # fmt: skip
        level = mask[a] & mask[b] & (np.abs(height[a] - height[b]) <= step)
        pairs.append(np.stack([number[a][level], number[b][level]]))
    i, j = np.concatenate(pairs, axis=1)
    n = int(mask.sum())
    _, piece = connected_components(coo_matrix((np.ones(len(i), bool), (i, j)), shape=(n, n)), directed=False)
    large = np.bincount(piece) * cell**2 >= min_area
    component = np.zeros(top.shape, np.int64)
    component[mask] = np.where(large[piece], np.cumsum(large)[piece], 0)
    small = mask & (component == 0)
    if small.any() and component.any():
        distance, index = ndimage.distance_transform_edt(component == 0, return_indices=True)
        near = small & (distance <= np.sqrt(min_area) / cell)
        component[near] = component[tuple(index)][near]
    return component


def nearest_value(values: F64, known: Bools) -> F64:
    """Fill every cell with the value of the nearest known one."""
    from scipy import ndimage

    index = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    return values[tuple(index)]


def rings(mask: Bools, raster: Raster, tolerance: float, min_area: float) -> list[F64]:
    """Rings (K, 2) of straight sides around the cells of a mask and its holes, inside to the left, local metres.

    Args:
        mask: (rows, columns).
        raster: raster of the mask.
        tolerance: largest distance of a side from the contour of the cells, metres.
        min_area: smallest area of a hole (courtyard), m2.
    """
    import cv2

    rows, columns = np.nonzero(mask)
    if not len(rows):
        return []
    low, high = (rows.min(), columns.min()), (rows.max() + 1, columns.max() + 1)
    part = np.pad(mask[low[0] : high[0], low[1] : high[1]], 3)
    image = part.repeat(PIXELS_PER_CELL, axis=0).repeat(PIXELS_PER_CELL, axis=1).astype(np.float32)
    image = cv2.GaussianBlur(image, (0, 0), 0.6 * PIXELS_PER_CELL)
    contours, tree = cv2.findContours((image > 0.5).astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    found = []
    for contour, links in zip(contours, tree[0] if tree is not None else (), strict=True):
        hole, points = links[3] >= 0, contour[:, 0].astype(np.float64)
        if len(points) < 4 * PIXELS_PER_CELL or (
            hole and cv2.contourArea(contour) * (raster.cell / PIXELS_PER_CELL) ** 2 < min_area
        ):
            continue
        local = ((points + 0.5) / PIXELS_PER_CELL - 3 + (low[1], low[0]) + raster.low) * raster.cell
        if (signed_area(local) > 0) == hole:
            local = local[::-1]
        ring = regularize(local, tolerance)
        if ring is not None:
            found.append(ring)
    return found


def regularize(contour: F64, tolerance: float) -> F64 | None:
    """Ring (K, 2) of straight sides along a contour (N, 2); None if it has fewer than three."""
    import cv2

    middle = contour.mean(axis=0)
    simple = cv2.approxPolyDP((contour - middle).astype(np.float32)[:, None], tolerance, closed=True)[:, 0]
    if len(simple) < 3:
        return None
    at = np.sort([int(np.argmin(((contour - middle - corner) ** 2).sum(axis=1))) for corner in simple])
    at = np.unique(at)
    if len(at) < 3:
        return None
    ends = list(zip(at, np.roll(at, -1), strict=True))
    runs = [np.take(contour, np.arange(i, j if j > i else j + len(contour)), axis=0, mode="wrap") for i, j in ends]
    lines = [_line(run, contour[j % len(contour)] - contour[i]) for run, (i, j) in zip(runs, ends, strict=True)]
    length = np.array([len(run) for run in runs], float)
    angle = np.array([np.arctan2(d[1], d[0]) for _, d in lines])
    off = _off_axis(angle - _main_direction(angle, length))
    angle = np.where(np.abs(off) < MAX_ALIGNMENT_RAD, angle - off, angle)
    lines = [(centre, np.array([np.cos(a), np.sin(a)])) for (centre, _), a in zip(lines, angle, strict=True)]
    corners: list[F64] = []
    for k, (i, _) in enumerate(ends):
        corners += _corner(contour[i], lines[k - 1], lines[k], tolerance)
    return np.array(corners)


def _main_direction(angle: F64, length: F64) -> float:
    """Direction (radians, modulo 90 degrees) of most sides (K,) by length; oblique sides have no influence."""
    off = _off_axis(angle - angle[:, None])
    weight = length * np.maximum(1 - np.abs(off) / MAX_ALIGNMENT_RAD, 0)
    direction = float(angle[int(weight.sum(axis=1).argmax())])
    for _ in range(MAIN_DIRECTION_ROUNDS):
        off = _off_axis(angle - direction)
        direction += float(np.average(off, weights=length * np.maximum(1 - np.abs(off) / MAX_ALIGNMENT_RAD, 0)))
    return direction


def _off_axis(angle: F64) -> F64:
    """Smallest rotation (radians) of each direction from the axes of a right-angled cross."""
    return (angle + np.pi / 4) % (np.pi / 2) - np.pi / 4


def _line(run: F64, along: F64) -> tuple[F64, F64]:
    """Point and direction of the line fitted to a run of points, oriented `along`."""
    cut = int(END_FRACTION * len(run))
    inner = run[cut : len(run) - cut] if len(run) - 2 * cut >= 3 else run
    centre = inner.mean(axis=0)
    direction = np.linalg.svd(inner - centre, full_matrices=False)[2][0] if len(inner) > 2 else along
    direction = direction if direction @ along >= 0 else -direction
    return centre, direction / max(float(np.linalg.norm(direction)), 1e-9)


def _corner(position: F64, before: tuple[F64, F64], after: tuple[F64, F64], tolerance: float) -> list[F64]:
    """Intersection of two lines near `position`; if there is none, the projections of `position` onto both."""
    (p, d), (q, e) = before, after
    cross = d[0] * e[1] - d[1] * e[0]
    if abs(cross) > np.sin(MIN_CORNER_RAD):
        t = ((q - p)[0] * e[1] - (q - p)[1] * e[0]) / cross
        if np.linalg.norm(p + t * d - position) < 3 * tolerance:
            return [p + t * d]
    return [p + ((position - p) @ d) * d, q + ((position - q) @ e) * e]
