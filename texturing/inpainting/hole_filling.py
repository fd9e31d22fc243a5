"""Hole filling of texture pages: texels that no photo saw take point colours, and charts are padded.

Points are about 10 cm apart and texels 1 cm, so colours are looked up on a coarse lattice of texels on each face, and
interpolated bilinearly in between. Import late: it loads numba.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from scan2sim.pipeline.core.classes import colour_of
from scan2sim.pipeline.core.types import F32, F64, I32, I64, U8, Bools
from scan2sim.pipeline.geometry.height_map import point_spacing
from scan2sim.texturing.texel_map import box, frame
from scan2sim.texturing.texture_page import FILLED, FROM_POINTS, SEEN, Page

LATTICE_SPACING_M = 0.08
"""Metres between the lattice nodes at which point colours are looked up."""
NEIGHBOURS = 4
"""Nearest points whose colours are averaged."""
MAX_POINT_DISTANCE_M = (0.25, 1.0)
"""Lower and upper bound of the distance up to which a point's colour counts as the surface's own (`FROM_POINTS`)."""
MAX_POINT_DISTANCE_SPACINGS = 3.0
"""That distance between the bounds, as a multiple of the point spacing."""
FAR_NEIGHBOURS, FAR_STRIDE = 32, 8
"""Farther away, colours are means of 32 points out of every 8th: a single point's colour would give a flat patch."""


POINTS_CHUNK = 100_000
"""Points whose neighbours are looked up at a time, to bound memory."""
PADDING_ROWS = 512
"""Rows of a page that are padded at a time, to bound memory."""


class PointColours:
    """Coloured points, with colour lookup at positions.

    Args:
        xyz: (N, 3) local metres, N > 0.
        rgb: (N, 3) uint8.
        mark: (N,) uint8 or one value for all: mark of the texels coloured by them (`FROM_POINTS` or `FILLED`).
        spacing: (N,) metres, spacing of points that were thinned more than others, else 0; None: of none.
    """

    def __init__(self, xyz: F32, rgb: U8, mark: int | U8 = FROM_POINTS, spacing: F32 | None = None) -> None:
        from scipy.spatial import cKDTree

        self._tree = cKDTree(xyz, balanced_tree=False, compact_nodes=False)
        self._rgb = rgb
        self._far = cKDTree(xyz[::FAR_STRIDE])
        usual = float(np.clip(MAX_POINT_DISTANCE_SPACINGS * point_spacing(xyz), *MAX_POINT_DISTANCE_M))
        thinned = np.zeros(len(xyz), np.float32) if spacing is None else spacing
        self._max_distance = np.maximum(usual, MAX_POINT_DISTANCE_SPACINGS * thinned)
        self._mark = np.broadcast_to(np.asarray(mark, np.uint8), len(xyz))

    def at(self, points: F32) -> tuple[F32, U8]:
        """Colours (M, 3) at `points` (M, 3), inverse-square distance weighted, and the nearest point's mark (M,).

        The mark is `FILLED` where the nearest point is too far.
        """
        colour, mark = np.empty((len(points), 3), np.float32), np.empty(len(points), np.uint8)
        for first in range(0, len(points), POINTS_CHUNK):
            part = slice(first, first + POINTS_CHUNK)
            colour[part], mark[part] = self._at(points[part])
        return colour, mark

    def _at(self, points: F32) -> tuple[F32, U8]:
        k = min(NEIGHBOURS, self._tree.n)
        distance, index = self._tree.query(points, k=k, workers=-1)
        distance, index = distance.reshape(len(points), k), index.reshape(len(points), k)
        colour, far = _mean(distance, index, self._rgb), distance[:, 0] > self._max_distance[index[:, 0]]
        if far.any():
            k = min(FAR_NEIGHBOURS, self._far.n)
            distance_far, index_far = self._far.query(points[far], k=k, workers=-1)
            shape = (len(distance_far), k)
            colour[far] = _mean(distance_far.reshape(shape), FAR_STRIDE * index_far.reshape(shape), self._rgb)
        mark = np.where(far, FILLED, self._mark[index[:, 0]])
        return colour, mark.astype(np.uint8)


@njit(cache=True, parallel=True)
def _mean(distance: F64, index: I64, rgb: U8) -> F32:
    """(M, 3) means of the colours at `index` (M, K), weighted by the inverse square of their distances (M, K)."""
    mean = np.empty((len(distance), 3), np.float32)
    for i in prange(len(distance)):
        total, r, g, b = 0.0, 0.0, 0.0, 0.0
        for k in range(distance.shape[1]):
            weight, at = 1 / (distance[i, k] ** 2 + 1e-4), index[i, k]
            total += weight
            r += weight * rgb[at, 0]
            g += weight * rgb[at, 1]
            b += weight * rgb[at, 2]
        mean[i, 0], mean[i, 1], mean[i, 2] = r / total, g / total, b / total
    return mean


def fill(page: Page, colours: PointColours, texel: float) -> None:
    """Colour the texels of faces that have no colour yet (`seen` 0), in place; far from any point, mark them as filled.

    Args:
        page: page to be filled.
        colours: colours of the points.
        texel: texel size in metres.
    """
    step = max(1, round(LATTICE_SPACING_M / texel))
    shape = _lattice(page.owner, page.seen, page.flat, step)
    start = np.concatenate([[0], np.cumsum(shape[:, 0].astype(np.int64) * shape[:, 1])])
    if start[-1] == 0:
        return
    points = _lattice_points(page.flat, page.corners, shape, start, step, page.owner.shape)
    used = _used_nodes(page.seen, page.owner, page.flat, shape, start, step)
    colour, mark = np.zeros(points.shape, np.float32), np.zeros(len(points), np.uint8)
    colour[used], mark[used] = colours.at(points[used])
    _interpolate(page.rgb, page.seen, page.owner, page.flat, shape, start, step, colour, mark)


def seen_points(page: Page, every: int) -> tuple[F32, U8]:
    """Positions (N, 3) and colours (N, 3) of every Nth texel (in both directions) that a photo saw."""
    rows, columns = np.nonzero(page.seen[::every, ::every] == SEEN)
    rows, columns = rows * every, columns * every
    return texel_points(page.owner, page.flat, page.corners, rows, columns), page.rgb[rows, columns]


def pad(rgb: U8, seen: U8, padding: int) -> None:
    """Extend the charts' colours outwards by `padding` texels (edge dilation); beyond, fill their mean. In place.

    This keeps the background out of bilinear lookups and mip-maps.
    """
    if not seen.any():
        rgb[:] = 128
        return
    sample = rgb[::97, ::97][seen[::97, ::97] > 0]
    background = np.round(sample.mean(axis=0) if len(sample) else np.full(3, 128.0)).astype(np.uint8)
    height = len(seen)
    for first in range(0, height, PADDING_ROWS):
        last = min(height, first + PADDING_ROWS)
        rows = slice(max(0, first - padding - 1), min(height, last + padding + 1))
        _pad_rows(rgb[rows], seen[rows], first - rows.start, last - rows.start, padding, background)


def _pad_rows(rgb: U8, seen: U8, first: int, last: int, padding: int, background: U8) -> None:
    """`pad` the rows from `first` to `last`; the others, within the padding, give colours only."""
    import cv2

    if not seen.any():
        rgb[first:last] = background
        return
    distance, nearest = cv2.distanceTransformWithLabels(
        (seen == 0).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    _dilate(rgb, np.flatnonzero(seen), distance[first:last], nearest[first:last], first, padding, background)


@njit(cache=True, parallel=True)
def _dilate(rgb: U8, coloured: I64, distance: F32, nearest: I32, first: int, padding: int, background: U8) -> None:
    """Colour the texels without a colour in rows from `first` on; label k of `nearest` is texel `coloured[k - 1]`."""
    height, width = distance.shape
    for y in prange(height):
        for x in range(width):
            if distance[y, x] > padding:
                for k in range(3):
                    rgb[first + y, x, k] = background[k]
            elif distance[y, x] > 0:
                row, column = divmod(coloured[nearest[y, x] - 1], width)
                for k in range(3):
                    rgb[first + y, x, k] = rgb[row, column, k]


@njit(cache=True, parallel=True)
def _lattice(owner: I32, seen: U8, flat: F32, step: int) -> I32:
    """(F, 2) int32 number of lattice nodes in x and y over every face with an unseen texel; zero for the others."""
    height, width = owner.shape
    shape = np.zeros((len(flat), 2), np.int32)
    for f in prange(len(flat)):
        x0, y0, x1, y1 = box(flat, f, width, height)
        has_unseen = False
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                if owner[y, x] == f and seen[y, x] == 0:
                    has_unseen = True
                    break
            if has_unseen:
                break
        if has_unseen:
            shape[f, 0], shape[f, 1] = (x1 - x0) // step + 2, (y1 - y0) // step + 2
    return shape


@njit(cache=True, parallel=True)
def _lattice_points(flat: F32, corners: F32, shape: I32, start: I64, step: int, size: tuple[int, int]) -> F32:
    """(N, 3) positions of the lattice nodes; those of face f begin at start[f]."""
    out = np.empty((start[-1], 3), np.float32)
    for f in prange(len(flat)):
        if shape[f, 0] == 0:
            continue
        origin, per_x, per_y, _ = frame(flat, corners, f)
        x0, y0, _, _ = box(flat, f, size[1], size[0])
        for j in range(shape[f, 1]):
            for i in range(shape[f, 0]):
                x, y = x0 + i * step, y0 + j * step
                for k in range(3):
                    out[start[f] + j * shape[f, 0] + i, k] = origin[k] + x * per_x[k] + y * per_y[k]
    return out


@njit(cache=True, parallel=True)
def _used_nodes(seen: U8, owner: I32, flat: F32, shape: I32, start: I64, step: int) -> Bools:
    """(N,) which lattice nodes `_interpolate` reads: those around unseen texels, not in the corners beside a face."""
    used = np.zeros(start[-1], np.bool_)
    height, width = owner.shape
    for f in prange(len(flat)):
        if shape[f, 0] == 0:
            continue
        x0, y0, x1, y1 = box(flat, f, width, height)
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                if owner[y, x] == f and seen[y, x] == 0:
                    i, j = (x - x0) // step, (y - y0) // step
                    a = start[f] + j * shape[f, 0] + i
                    right, below = (x - x0) % step > 0, (y - y0) % step > 0
                    used[a] = True
                    used[a + 1] |= right
                    used[a + shape[f, 0]] |= below
                    used[a + shape[f, 0] + 1] |= right and below
    return used


@njit(cache=True, parallel=True)
def _interpolate(
    rgb: U8, seen: U8, owner: I32, flat: F32, shape: I32, start: I64, step: int, colour: F32, mark: U8
) -> None:
    height, width = owner.shape
    for f in prange(len(flat)):
        if shape[f, 0] == 0:
            continue
        x0, y0, x1, y1 = box(flat, f, width, height)
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                if owner[y, x] != f or seen[y, x] != 0:
                    continue
                i, j = (x - x0) // step, (y - y0) // step
                fx, fy = (x - x0) / step - i, (y - y0) / step - j
                a = start[f] + j * shape[f, 0] + i
                b = a + shape[f, 0]
                for k in range(3):
                    upper = colour[a, k] * (1 - fx) + colour[a + 1, k] * fx
                    lower = colour[b, k] * (1 - fx) + colour[b + 1, k] * fx
                    rgb[y, x, k] = min(255.0, upper * (1 - fy) + lower * fy + 0.5)
                seen[y, x] = mark[a]


@njit(cache=True, parallel=True)
def texel_points(owner: I32, flat: F32, corners: F32, rows: I64, columns: I64) -> F32:
    """(N, 3) positions, local metres, of the texels at rows and columns (N,) of a page, on the faces that own them."""
    out = np.empty((len(rows), 3), np.float32)
    for i in prange(len(rows)):
        f = owner[rows[i], columns[i]]
        origin, per_x, per_y, _ = frame(flat, corners, f)
        for k in range(3):
            out[i, k] = origin[k] + columns[i] * per_x[k] + rows[i] * per_y[k]
    return out


def shaded(classification: U8, normal: npt.NDArray[np.floating] | None) -> U8:
    """(N, 3) display colours of classes (N,), slightly darker where normals (N, 3) don't point up."""
    rgb = colour_of()[classification].astype(np.float32)
    if normal is not None:
        rgb *= (0.75 + 0.25 * np.clip(normal @ np.array([0.3, 0.2, 0.93]), 0, 1))[:, None]
    return rgb.astype(np.uint8)
