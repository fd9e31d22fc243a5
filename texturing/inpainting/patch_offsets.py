"""Image inpainting by patch offsets, which continues patterns into holes. Import late: it loads numba.

Each cell of a hole is copied from another cell at one of a few offsets: the dominant offsets at which patches of the
known surroundings match each other (He and Sun 2012, "Statistics of Patch Offsets for Image Completion"). Joints, kerbs
and markings are thereby continued. The offset of each cell is selected by a Markov random field in which neighbours
with different offsets pay for the visible seam (Pritch et al. 2009, "Shift-Map Image Editing"), solved by message
passing on a coarse image. The copied colours are then corrected to match the border of the hole by a Poisson equation
(Poisson image editing), also on the coarse image.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from scan2sim.pipeline.core.types import F32, F64, I32, Bools

COARSE_FACTOR = 4
"""Cells per coarse cell in each direction."""
MAX_OFFSETS = 24
"""Number of dominant offsets that are used."""
PATCH_CELLS = 6
"""Side of the patches that are compared, coarse cells."""
MIN_OFFSET_CELLS, MAX_OFFSET_CELLS = 6, 160
"""Range of offsets in coarse cells: at shorter ones everything is similar, longer ones lead to another street."""
MAX_QUERIES = 20_000
"""Number of patches for which the most similar one is searched."""
PCA_COMPONENTS = 12
"""Principal components by which patches are compared."""
MRF_SWEEPS = 6
"""Message passing sweeps over the image, each forwards and back."""
CLASS_MISMATCH_COST = 900.0
"""Cost of copying from a surface of another class, in squared grey levels: 30 levels."""
IMPOSSIBLE_COST = 1e7
"""Cost of an offset that doesn't lead to a known cell."""
NEIGHBOUR_STEPS = ((0, 1), (1, 0), (0, -1), (-1, 0))
MAX_CELLS_PER_PASS = 60_000
"""Coarse cells that are solved at a time: those nearest to known cells first."""
PASSES = 4
"""Passes in which filled cells can be copied from, so that wide holes are closed from their border inwards."""


def inpaint(rgb: F32, known: Bools, wanted: Bools, classes: I32 | None = None) -> tuple[F32, Bools]:
    """Image with its holes inpainted.

    Args:
        rgb: (H, W, 3) colours, 0 to 255; read where `known`. Changed in place, if possible, to save memory.
        known: (H, W) cells with a colour.
        wanted: (H, W) cells to be filled; cells that are neither known nor wanted are ignored.
        classes: surface class of every coarse cell (`COARSE_FACTOR` cells in each direction), negative where unknown;
            cells are preferably copied from the same class.

    Returns:
        rgb (H, W, 3) float32, and (H, W) which cells were filled: not those that are too far from known cells.
    """
    height, width = known.shape
    pad = ((0, -height % COARSE_FACTOR), (0, -width % COARSE_FACTOR))
    if pad != ((0, 0), (0, 0)):
        rgb = np.pad(rgb, (*pad, (0, 0)))
    known = np.pad(known, pad)
    wanted = np.pad(wanted, pad) & ~known
    rgb[~known] = 0
    out = np.zeros(known.shape, bool)
    if classes is None:
        classes = np.full((known.shape[0] // COARSE_FACTOR, known.shape[1] // COARSE_FACTOR), -1, np.int32)
    offsets = np.zeros((0, 2), np.int32)
    for _ in range(PASSES):
        coarse, fully_known, hole = _coarse(rgb, known, wanted)
        hole = _nearest(hole, fully_known, MAX_CELLS_PER_PASS)
        if not hole.any() or not fully_known.any():
            break
        offsets = offsets if len(offsets) else dominant_offsets(coarse, fully_known, hole)
        if not len(offsets):
            break
        selected = select_offsets(coarse, fully_known, hole, classes, offsets)
        tone = tone_correction(coarse, fully_known, hole, offsets, selected)
        if not _copy(rgb, known, wanted, out, offsets, selected, tone):
            break
    return rgb[:height, :width], out[:height, :width]


@njit(cache=True, parallel=True)
def _coarse(rgb: F32, known: Bools, wanted: Bools) -> tuple[F32, Bools, Bools]:
    """Mean colours of coarse cells, which of them are wholly known, and which have cells to be filled."""
    height, width = rgb.shape[0] // COARSE_FACTOR, rgb.shape[1] // COARSE_FACTOR
    mean = np.zeros((height, width, 3), np.float32)
    fully_known, hole = np.zeros((height, width), np.bool_), np.zeros((height, width), np.bool_)
    for y in prange(height):
        for x in range(width):
            count, has_wanted, r, g, b = 0, False, 0.0, 0.0, 0.0
            for row in range(y * COARSE_FACTOR, (y + 1) * COARSE_FACTOR):
                for column in range(x * COARSE_FACTOR, (x + 1) * COARSE_FACTOR):
                    has_wanted |= wanted[row, column]
                    if known[row, column]:
                        count += 1
                        r += rgb[row, column, 0]
                        g += rgb[row, column, 1]
                        b += rgb[row, column, 2]
            if count > 0:
                mean[y, x, 0], mean[y, x, 1], mean[y, x, 2] = r / count, g / count, b / count
            fully_known[y, x] = count == COARSE_FACTOR**2
            hole[y, x] = has_wanted and not fully_known[y, x]
    return mean, fully_known, hole


def _nearest(hole: Bools, fully_known: Bools, limit: int) -> Bools:
    """The cells of the hole nearest to known cells, at most `limit`."""
    from scipy import ndimage

    if hole.sum() <= limit or not fully_known.any():
        return hole
    distance = ndimage.distance_transform_edt(~fully_known)
    return hole & (distance < np.partition(distance[hole], limit)[limit])


def dominant_offsets(coarse: F32, fully_known: Bools, hole: Bools) -> I32:
    """(K, 2) most frequent offsets (rows, columns) between similar known patches around the hole, best first."""
    from scipy import ndimage
    from scipy.spatial import cKDTree

    near = ndimage.distance_transform_edt(~hole) <= MAX_OFFSET_CELLS
    full = ndimage.minimum_filter(fully_known & near, PATCH_CELLS, origin=-(PATCH_CELLS // 2), mode="constant")
    row, column = np.nonzero(full)
    if len(row) < MAX_OFFSETS:
        return np.zeros((0, 2), np.int32)
    every = max(1, len(row) // (2 * MAX_QUERIES))
    row, column = row[::every], column[::every]
    window = np.arange(PATCH_CELLS)
    patches = coarse[row[:, None, None] + window[:, None], column[:, None, None] + window].reshape(len(row), -1)
    patches = patches - patches.mean(axis=0)
    covariance = patches.T @ patches
    features = patches @ np.linalg.eigh(covariance)[1][:, -PCA_COMPONENTS:]
    queries = slice(None, None, max(1, len(row) // MAX_QUERIES))
    found = cKDTree(features).query(features[queries], k=min(24, len(row)), workers=-1)[1]
    offset = np.stack([row[found] - row[queries][:, None], column[found] - column[queries][:, None]], axis=-1)
    length = np.abs(offset).max(axis=-1)
    good = (length >= MIN_OFFSET_CELLS) & (length <= MAX_OFFSET_CELLS)
    first = np.argmax(good, axis=1)  # the most similar patch that isn't the patch itself
    offset = offset[np.arange(len(offset)), first][good.any(axis=1)]
    size = 2 * MAX_OFFSET_CELLS + 1
    votes = np.bincount((offset[:, 0] + MAX_OFFSET_CELLS) * size + offset[:, 1] + MAX_OFFSET_CELLS, minlength=size**2)
    smooth = ndimage.gaussian_filter(votes.reshape(size, size).astype(np.float64), 1.4)
    smooth += smooth[::-1, ::-1]  # similarity is symmetric
    peaks = (smooth == ndimage.maximum_filter(smooth, 5)) & (smooth > 0)
    y, x = np.nonzero(peaks)
    best = np.argsort(-smooth[y, x], kind="stable")[:MAX_OFFSETS]
    return np.stack([y[best], x[best]], axis=1).astype(np.int32) - MAX_OFFSET_CELLS


def select_offsets(coarse: F32, fully_known: Bools, hole: Bools, classes: I32, offsets: I32) -> I32:
    """(H, W) index of the offset selected for each coarse cell of the hole; -1 where none leads to known cells."""
    number = np.full(hole.shape, -1, np.int32)
    cells = np.argwhere(hole).astype(np.int32)
    number[hole] = np.arange(len(cells))
    source, cost = _data_costs(coarse, fully_known, hole, classes, offsets)
    selected = _pass_messages(number, cells, source, cost, MRF_SWEEPS)
    out = np.full(hole.shape, -1, np.int32)
    out[hole] = selected
    return out


def _data_costs(coarse: F32, fully_known: Bools, hole: Bools, classes: I32, offsets: I32) -> tuple[F32, F32]:
    """(N, K, 3) source colour of each offset at each cell of the hole, and (N, K) its cost: border and class."""
    height, width = fully_known.shape
    y, x = np.nonzero(hole)

    def at(u: npt.NDArray[Any], v: npt.NDArray[Any]) -> tuple[npt.NDArray[Any], npt.NDArray[Any], Bools]:
        within = (u >= 0) & (u < height) & (v >= 0) & (v < width)
        u, v = np.where(within, u, 0), np.where(within, v, 0)
        return u, v, within & fully_known[u, v]

    source, cost = np.zeros((len(y), len(offsets), 3), np.float32), np.zeros((len(y), len(offsets)), np.float32)
    own_class = classes[y, x]
    for a, (dy, dx) in enumerate(offsets):
        u, v, fits = at(y + dy, x + dx)
        source[:, a] = coarse[u, v]
        source_class = classes[u, v]
        mismatch = (own_class >= 0) & (source_class >= 0) & (own_class != source_class)
        cost[:, a] = np.where(mismatch, CLASS_MISMATCH_COST, 0)
        for sy, sx in NEIGHBOUR_STEPS:
            q, r, rim = at(y + sy, x + sx)
            s, t, inside = at(y + sy + dy, x + sx + dx)
            apart = ((coarse[q, r] - coarse[s, t]) ** 2).sum(axis=1)
            cost[:, a] += np.where(rim, np.where(inside, apart, CLASS_MISMATCH_COST), 0)
        cost[~fits, a] = IMPOSSIBLE_COST
    return source, cost


@njit(cache=True, fastmath=True)
def _pass_messages(number: I32, cells: I32, source: F32, cost: F32, sweeps: int) -> I32:
    """Offset of each cell by min-sum message passing, in raster order and back; -1 where all are impossible."""
    height, width = number.shape
    n, count = cost.shape
    message = np.zeros((n, 4, count), np.float32)  # from the neighbour in each direction
    belief = np.empty(count, np.float32)
    for sweep in range(2 * sweeps):
        first = 0 if sweep % 2 == 0 else 2
        for k in range(n):
            i = k if first == 0 else n - 1 - k
            y, x = cells[i]
            for direction in range(first, first + 2):
                q, r = y + NEIGHBOUR_STEPS[direction][0], x + NEIGHBOUR_STEPS[direction][1]
                if not (0 <= q < height and 0 <= r < width) or number[q, r] < 0:
                    continue
                j, back = number[q, r], (direction + 2) % 4
                for a in range(count):
                    belief[a] = cost[i, a] - message[i, direction, a]
                    for other in range(4):
                        belief[a] += message[i, other, a]
                least = belief.min()
                for b in range(count):
                    best = belief[b]
                    for a in range(count):
                        if belief[a] >= best:
                            continue
                        seam = np.float32(0)
                        for c in range(3):
                            here, inside = source[i, a, c] - source[i, b, c], source[j, a, c] - source[j, b, c]
                            seam += here * here + inside * inside
                        best = min(best, belief[a] + seam)
                    message[j, back, b] = best - least
    chosen = np.full(n, -1, np.int32)
    for i in range(n):
        best = np.float32(IMPOSSIBLE_COST)
        for a in range(count):
            total = cost[i, a]
            for other in range(4):
                total += message[i, other, a]
            if cost[i, a] < IMPOSSIBLE_COST and (chosen[i] < 0 or total < best):
                chosen[i], best = a, total
    return chosen


def tone_correction(coarse: F32, fully_known: Bools, hole: Bools, offsets: I32, selected: I32) -> F32:
    """(H, W, 3) colour to be added to copied cells: keeps gradients, matches the hole's border (Poisson equation)."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.linalg import splu

    inside = hole & (selected >= 0)
    y, x = np.nonzero(inside)
    n = len(y)
    out = np.zeros((*hole.shape, 3), np.float32)
    if n == 0:
        return out
    number = np.full(hole.shape, -1)
    number[inside] = np.arange(n)
    offset = offsets[selected[inside]]
    copied = coarse[y + offset[:, 0], x + offset[:, 1]].astype(np.float64)
    diagonal, right = np.full(n, 1e-6), np.zeros((n, 3))
    rows, columns = [], []
    for dy, dx in NEIGHBOUR_STEPS:
        q, r = y + dy, x + dx
        here = (q >= 0) & (q < hole.shape[0]) & (r >= 0) & (r < hole.shape[1])
        q, r = np.where(here, q, 0), np.where(here, r, 0)
        other = np.where(here, number[q, r], -1)
        rim = here & (other < 0) & fully_known[q, r]
        # gradient of the source image, from the cell to its neighbour
        gradient = _source_gradient(coarse, fully_known, q, r, offset, copied)
        i = np.flatnonzero(other >= 0)
        j = other[i]
        back = _source_gradient(coarse, fully_known, y[i], x[i], offset[j], copied[j])
        mean = (gradient[i] - back) / 2  # mean over both cells' sources; equal where both have the same offset
        # tone t: (copied + t) at j minus (copied + t) at i should be `mean`
        rows.append(i)
        columns.append(j)
        diagonal[i] += 1
        np.add.at(right, i, copied[j] - copied[i] - mean)
        edge = np.flatnonzero(rim)
        diagonal[edge] += 1
        right[edge] += coarse[q[edge], r[edge]] - copied[edge] - gradient[edge]
    a, b = np.concatenate([*rows, np.arange(n)]), np.concatenate([*columns, np.arange(n)])
    entries = np.concatenate([np.full(sum(map(len, rows)), -1.0), diagonal])
    matrix = coo_matrix((entries, (a, b)), shape=(n, n)).tocsc()
    factors = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    out[inside] = factors.solve(right)
    return out


def _source_gradient(
    coarse: F32, fully_known: Bools, q: npt.NDArray[Any], r: npt.NDArray[Any], offset: I32, copied: F64
) -> F64:
    """(N, 3) difference of the image at offsets from (q, r) to the colours `copied`; 0 where it isn't known."""
    u, v = q + offset[:, 0], r + offset[:, 1]
    inside = (u >= 0) & (u < fully_known.shape[0]) & (v >= 0) & (v < fully_known.shape[1])
    u, v = np.where(inside, u, 0), np.where(inside, v, 0)
    inside &= fully_known[u, v]
    return np.where(inside[:, None], coarse[u, v] - copied, 0.0)


@njit(cache=True, parallel=True)
def _copy(rgb: F32, known: Bools, wanted: Bools, out: Bools, offsets: I32, selected: I32, tone: F32) -> int:
    """Copy cells by their offsets into `rgb`, and mark them in the masks, all in place; returns their number.

    The tone is interpolated between the coarse cells that have one.
    """
    height, width = selected.shape
    total = 0
    for row in prange(rgb.shape[0]):
        for column in range(rgb.shape[1]):
            k = selected[row // COARSE_FACTOR, column // COARSE_FACTOR]
            if k < 0 or not wanted[row, column]:
                continue
            y, x = (row + 0.5) / COARSE_FACTOR - 0.5, (column + 0.5) / COARSE_FACTOR - 0.5
            y0, x0 = math.floor(y), math.floor(x)
            weight, r, g, b = 0.0, 0.0, 0.0, 0.0
            for down in range(2):
                for right in range(2):
                    i, j = min(max(y0 + down, 0), height - 1), min(max(x0 + right, 0), width - 1)
                    if selected[i, j] >= 0:
                        share = (y - y0 if down else 1 - y + y0) * (x - x0 if right else 1 - x + x0)
                        weight += share
                        r += share * tone[i, j, 0]
                        g += share * tone[i, j, 1]
                        b += share * tone[i, j, 2]
            weight = max(weight, 1e-3)
            source = rgb[row + COARSE_FACTOR * offsets[k, 0], column + COARSE_FACTOR * offsets[k, 1]]
            rgb[row, column, 0] = min(255.0, max(0.0, source[0] + r / weight))
            rgb[row, column, 1] = min(255.0, max(0.0, source[1] + g / weight))
            rgb[row, column, 2] = min(255.0, max(0.0, source[2] + b / weight))
            known[row, column], wanted[row, column], out[row, column] = True, False, True
            total += 1
    return total
