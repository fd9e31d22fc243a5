"""A picture's holes closed by what is around, patterns kept. Import late: it loads numba.

Each place of a hole is copied from another place at one of a few shifts, those at which the known surroundings are
most like themselves (He and Sun 2012, "Statistics of Patch Offsets for Image Completion"): joints, kerbs and markings
go on where they went. Which shift goes where is a Markov random field: neighbours that are copied from different places
pay for what shows at the seam (Pritch et al. 2009, "Shift-Map Image Editing"), solved by passing messages on a coarse
picture. What is copied is then toned so that it meets the rim: a Poisson equation, on the coarse picture too.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from scan2sim.pipeline.core.types import F32, F64, I32, Bools

FACTOR = 4
"""Cells each way that make one of the coarse picture."""
SHIFTS = 24
"""Shifts that are tried."""
PATCH = 6
"""Coarse cells of the patches that are compared, each way."""
NEAREST, FARTHEST = 6, 160
"""Coarse cells that a shift may span: nearer, everything is like itself; farther, another street."""
QUERIES = 20_000
"""Patches for which one like them is searched."""
FEATURES = 12
"""Principal components that patches are compared by."""
SWEEPS = 6
"""Messages go through the picture so often, forwards and back."""
STRANGE = 900.0
"""Price of a place of another kind, in squared grey levels: 30 levels."""
NEVER = 1e7
STEPS = ((0, 1), (1, 0), (0, -1), (-1, 0))
MOST = 60_000
"""Coarse cells that are solved at a time: those nearest to what is known go first."""
ROUNDS = 4
"""What has been filled may be copied on, so often: a wide hole is closed from its rim inwards."""


def continued(rgb: F32, known: Bools, wanted: Bools, kind: I32 | None = None) -> tuple[F32, Bools]:
    """A picture with its holes closed.

    Args:
        rgb: (H, W, 3) colours, 0 to 255; read where `known`.
        known: (H, W).
        wanted: (H, W) what is to be filled; cells that are neither are left alone, and nothing is copied from them.
        kind: of surface, for every `FACTOR` cells each way, which what is copied should have, too; negative where
            that isn't known.

    Returns:
        rgb (H, W, 3) float32 and (H, W) bool, which cells were filled: not those that nothing fits, which no known
        place is near enough to.
    """
    height, width = known.shape
    rgb, out = np.where(known[..., None], rgb, 0).astype(np.float32), np.zeros(known.shape, bool)
    pad = ((0, -height % FACTOR), (0, -width % FACTOR))
    rgb, known = np.pad(rgb, (*pad, (0, 0))), np.pad(known, pad)
    wanted = np.pad(wanted, pad) & ~known
    if kind is None:
        kind = np.full((known.shape[0] // FACTOR, known.shape[1] // FACTOR), -1, np.int32)
    shifts = np.zeros((0, 2), np.int32)
    for _ in range(ROUNDS):
        coarse, whole, hole = _coarse(rgb, known, wanted)
        hole = _nearest(hole, whole, MOST)
        if not hole.any() or not whole.any():
            break
        shifts = shifts if len(shifts) else offsets(coarse, whole, hole)
        if not len(shifts):
            break
        shift = choose(coarse, whole, hole, kind, shifts)
        tone = toned(coarse, whole, hole, shifts, shift)
        filled = _copy(rgb, known, wanted, shifts, shift, tone)
        if not filled.any():
            break
        known, wanted = known | filled, wanted & ~filled
        out |= filled[:height, :width]
    return np.ascontiguousarray(rgb[:height, :width]), out


def _coarse(rgb: F32, known: Bools, wanted: Bools) -> tuple[F32, Bools, Bools]:
    """Mean colours of coarse cells, which of them are wholly known, and which have something to be filled."""
    blocks = (rgb.shape[0] // FACTOR, FACTOR, rgb.shape[1] // FACTOR, FACTOR)
    count = np.asarray(known.reshape(blocks).sum(axis=(1, 3)))
    mean = rgb.reshape(*blocks, 3).sum(axis=(1, 3)) / np.maximum(count, 1)[..., None]
    whole, hole = count == FACTOR**2, np.asarray(wanted.reshape(blocks).any(axis=(1, 3)), bool)
    return mean.astype(np.float32), whole, hole & ~whole


def _nearest(hole: Bools, whole: Bools, most: int) -> Bools:
    """Of the hole, the cells nearest to what is known, `most` at most."""
    from scipy import ndimage

    if hole.sum() <= most or not whole.any():
        return hole
    distance = ndimage.distance_transform_edt(~whole)
    return hole & (distance < np.partition(distance[hole], most)[most])


def offsets(coarse: F32, whole: Bools, hole: Bools) -> I32:
    """(K, 2) shifts (rows, columns) at which known patches around the hole find others like them, best first."""
    from scipy import ndimage
    from scipy.spatial import cKDTree

    near = ndimage.distance_transform_edt(~hole) <= FARTHEST
    full = ndimage.minimum_filter(whole & near, PATCH, origin=-(PATCH // 2), mode="constant")
    row, column = np.nonzero(full)
    if len(row) < SHIFTS:
        return np.zeros((0, 2), np.int32)
    every = max(1, len(row) // (2 * QUERIES))
    row, column = row[::every], column[::every]
    reach = np.arange(PATCH)
    patches = coarse[row[:, None, None] + reach[:, None], column[:, None, None] + reach].reshape(len(row), -1)
    patches = patches - patches.mean(axis=0)
    spread = patches.T @ patches
    features = patches @ np.linalg.eigh(spread)[1][:, -FEATURES:]
    queries = slice(None, None, max(1, len(row) // QUERIES))
    found = cKDTree(features).query(features[queries], k=min(24, len(row)), workers=-1)[1]
    apart = np.stack([row[found] - row[queries][:, None], column[found] - column[queries][:, None]], axis=-1)
    far = np.abs(apart).max(axis=-1)
    good = (far >= NEAREST) & (far <= FARTHEST)
    first = np.argmax(good, axis=1)  # the most similar one that isn't the patch itself
    apart = apart[np.arange(len(apart)), first][good.any(axis=1)]
    size = 2 * FARTHEST + 1
    votes = np.bincount((apart[:, 0] + FARTHEST) * size + apart[:, 1] + FARTHEST, minlength=size**2)
    smooth = ndimage.gaussian_filter(votes.reshape(size, size).astype(np.float64), 1.4)
    smooth += smooth[::-1, ::-1]  # what goes there comes back
    peaks = (smooth == ndimage.maximum_filter(smooth, 5)) & (smooth > 0)
    y, x = np.nonzero(peaks)
    best = np.argsort(-smooth[y, x], kind="stable")[:SHIFTS]
    return np.stack([y[best], x[best]], axis=1).astype(np.int32) - FARTHEST


def choose(coarse: F32, whole: Bools, hole: Bools, kind: I32, shifts: I32) -> I32:
    """(H, W) index of the shift that each coarse cell of the hole is copied by; -1 where none leads to known cells."""
    number = np.full(hole.shape, -1, np.int32)
    cells = np.argwhere(hole).astype(np.int32)
    number[hole] = np.arange(len(cells))
    shown, cost = _shown(coarse, whole, hole, kind, shifts)
    chosen = _pass_messages(number, cells, shown, cost, SWEEPS)
    out = np.full(hole.shape, -1, np.int32)
    out[hole] = chosen
    return out


def _shown(coarse: F32, whole: Bools, hole: Bools, kind: I32, shifts: I32) -> tuple[F32, F32]:
    """(N, K, 3) what each shift shows at each cell of the hole, and (N, K) its cost there: the rim, and its kind."""
    height, width = whole.shape
    y, x = np.nonzero(hole)

    def at(u: npt.NDArray[Any], v: npt.NDArray[Any]) -> tuple[npt.NDArray[Any], npt.NDArray[Any], Bools]:
        within = (u >= 0) & (u < height) & (v >= 0) & (v < width)
        u, v = np.where(within, u, 0), np.where(within, v, 0)
        return u, v, within & whole[u, v]

    shown, cost = np.zeros((len(y), len(shifts), 3), np.float32), np.zeros((len(y), len(shifts)), np.float32)
    mine = kind[y, x]
    for a, (dy, dx) in enumerate(shifts):
        u, v, fits = at(y + dy, x + dx)
        shown[:, a] = coarse[u, v]
        cost[:, a] = np.where((mine >= 0) & (kind[u, v] >= 0) & (mine != kind[u, v]), STRANGE, 0)
        for sy, sx in STEPS:
            q, r, rim = at(y + sy, x + sx)
            s, t, there = at(y + sy + dy, x + sx + dx)
            apart = ((coarse[q, r] - coarse[s, t]) ** 2).sum(axis=1)
            cost[:, a] += np.where(rim, np.where(there, apart, STRANGE), 0)
        cost[~fits, a] = NEVER
    return shown, cost


@njit(cache=True, fastmath=True)
def _pass_messages(number: I32, cells: I32, shown: F32, cost: F32, sweeps: int) -> I32:
    """The shift of each cell after so many sweeps (min-sum, in raster order and back); -1 where all are impossible."""
    height, width = number.shape
    n, count = cost.shape
    message = np.zeros((n, 4, count), np.float32)  # by the neighbour in each direction
    belief = np.empty(count, np.float32)
    for sweep in range(2 * sweeps):
        first = 0 if sweep % 2 == 0 else 2
        for k in range(n):
            i = k if first == 0 else n - 1 - k
            y, x = cells[i]
            for direction in range(first, first + 2):
                q, r = y + STEPS[direction][0], x + STEPS[direction][1]
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
                            here, there = shown[i, a, c] - shown[i, b, c], shown[j, a, c] - shown[j, b, c]
                            seam += here * here + there * there
                        best = min(best, belief[a] + seam)
                    message[j, back, b] = best - least
    chosen = np.full(n, -1, np.int32)
    for i in range(n):
        best = np.float32(NEVER)
        for a in range(count):
            total = cost[i, a]
            for other in range(4):
                total += message[i, other, a]
            if cost[i, a] < NEVER and (chosen[i] < 0 or total < best):
                chosen[i], best = a, total
    return chosen


def toned(coarse: F32, whole: Bools, hole: Bools, shifts: I32, shift: I32) -> F32:
    """(H, W, 3) what is to be added to what is copied: it keeps its gradients and meets the rim's colours."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.linalg import splu

    inside = hole & (shift >= 0)
    y, x = np.nonzero(inside)
    n = len(y)
    out = np.zeros((*hole.shape, 3), np.float32)
    if n == 0:
        return out
    number = np.full(hole.shape, -1)
    number[inside] = np.arange(n)
    by = shifts[shift[inside]]
    copied = coarse[y + by[:, 0], x + by[:, 1]].astype(np.float64)
    diagonal, right = np.full(n, 1e-6), np.zeros((n, 3))
    rows, columns = [], []
    for dy, dx in STEPS:
        q, r = y + dy, x + dx
        here = (q >= 0) & (q < hole.shape[0]) & (r >= 0) & (r < hole.shape[1])
        q, r = np.where(here, q, 0), np.where(here, r, 0)
        other = np.where(here, number[q, r], -1)
        rim = here & (other < 0) & whole[q, r]
        step = _beyond(coarse, whole, q, r, by, copied)  # by how much the source changes from here to there
        i = np.flatnonzero(other >= 0)
        j = other[i]
        back = _beyond(coarse, whole, y[i], x[i], by[j], copied[j])
        mean = (step[i] - back) / 2  # both sides' idea of the step; the same where they are copied alike
        # tone t: (copied + t) at j less that at i is to be `mean`
        rows.append(i)
        columns.append(j)
        diagonal[i] += 1
        np.add.at(right, i, copied[j] - copied[i] - mean)
        edge = np.flatnonzero(rim)
        diagonal[edge] += 1
        right[edge] += coarse[q[edge], r[edge]] - copied[edge] - step[edge]
    a, b = np.concatenate([*rows, np.arange(n)]), np.concatenate([*columns, np.arange(n)])
    entries = np.concatenate([np.full(sum(map(len, rows)), -1.0), diagonal])
    matrix = coo_matrix((entries, (a, b)), shape=(n, n)).tocsc()
    factors = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    out[inside] = factors.solve(right)
    return out


def _beyond(coarse: F32, whole: Bools, q: npt.NDArray[Any], r: npt.NDArray[Any], by: I32, copied: F64) -> F64:
    """(N, 3) how the picture at shifts `by` from (q, r) differs from `copied`; 0 where it isn't known."""
    u, v = q + by[:, 0], r + by[:, 1]
    there = (u >= 0) & (u < whole.shape[0]) & (v >= 0) & (v < whole.shape[1])
    u, v = np.where(there, u, 0), np.where(there, v, 0)
    there &= whole[u, v]
    return np.where(there[:, None], coarse[u, v] - copied, 0.0)


def _copy(rgb: F32, known: Bools, wanted: Bools, shifts: I32, shift: I32, tone: F32) -> Bools:
    """Copy into `rgb`, in place; returns (H, W) which cells were filled."""
    import cv2

    y, x = np.nonzero(wanted & np.repeat(np.repeat(shift >= 0, FACTOR, axis=0), FACTOR, axis=1))
    by = FACTOR * shifts[shift[y // FACTOR, x // FACTOR]]
    smooth = np.asarray(cv2.resize(tone, rgb.shape[1::-1], interpolation=cv2.INTER_LINEAR))
    # towards cells without a tone the interpolation would fade: there the cell's own counts
    has = np.asarray(cv2.resize((shift >= 0).astype(np.float32), rgb.shape[1::-1], interpolation=cv2.INTER_LINEAR))
    add = smooth[y, x] / np.maximum(has[y, x], 1e-3)[:, None]
    rgb[y, x] = np.clip(rgb[y + by[:, 0], x + by[:, 1]] + add, 0, 255)
    filled = np.zeros(known.shape, bool)
    filled[y, x] = True
    return filled
