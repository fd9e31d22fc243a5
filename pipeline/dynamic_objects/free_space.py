"""Free space: where a scanner's rays have passed, and where therefore nothing stands.

Every return proves that its ray was empty up to it. Space is cut into voxels, time into windows about as long as a
turn of a spinning scanner. In a window a voxel is *hit* where a return lies in it or beside it, else it is *passed*
where so many rays went through it that they would have hit a thing of its size. A place is free if it and all its
neighbours were passed in several windows, and it was seldom hit. What no ray has been behind is never free: roads and
walls stay however flatly they are seen, and whatever a pose is off by less than a voxel. Thin and see-through things
stay as they are hit again and again. Each time that the scanner comes by is judged by itself: what it saw through once,
however often it was hit an hour before, has left. A thing's outermost layer lies beside what no ray has passed (the
road below, the sky above): it goes with the rest of its thing, where rays passed at least its own voxel.

Rays are followed exactly, each from where the scanner was at its moment, so any scanner will do that sees a place more
than once: one that spins in every turn, a profile scanner in every pass.

After DUFOMap (Duberg et al., "DUFOMap: Efficient Dynamic Awareness Mapping", RA-L 2024), with votes over windows in
place of its single sight. Import this module late: it loads numba.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from scan2sim.pipeline.core.types import F32, F64, I32, I64, U8, Bools

BLOCK = 32.0
"""Metres: space is worked on in square blocks of this side, one a thread, which bounds memory."""
RAYS = 2
"""Rays through a voxel in one window that make a pass: farther apart, they miss what is narrower than it."""
FREE, OPEN, STANDS = 1, 2, 3
"""What is said of a point: its voxel is free with all around it; or it alone is, passed twice as often as hit; or it
was looked at as often, and is neither. 0: it wasn't."""
LAYER = 1.5
"""Voxels from a point in free space up to which those that are open, of the same window, are of the same thing."""
PAUSE = 100
"""Windows without a point, after which the scanner comes by another time."""
HALO = 2
"""Voxels around a block: its own voxels' neighbours, and theirs."""


def in_free_space(
    xyz: F32,
    origins: F32,
    windows: I64,
    *,
    voxel: float,
    reach: float,
    votes: int,
    low: float = -np.inf,
    high: float = np.inf,
) -> tuple[Bools, float]:
    """(N,) which points lie where other rays have found nothing; and the share of points that rays can tell of.

    Args:
        xyz: (N, 3) local metres, in order of time.
        origins: (N, 3) where the scanner was when it measured each; NaN where that isn't known.
        windows: (N,) number of each point's window of time, ascending.
        voxel: metres; poses must be better than this.
        reach: metres from the scanner up to which rays count: beyond, what angles are off by may exceed a voxel.
        votes: windows that must have passed a place.
        low, high: heights (local z, metres) between which points are classified.
    """
    first = np.flatnonzero(np.diff(windows, prepend=windows[:1] - 1))
    again = np.append(False, np.diff(windows[first]) > PAUSE)
    starts = np.append(first, len(xyz))
    candidates = (xyz[:, 2] > low) & (xyz[:, 2] < high)
    path = origins[np.isfinite(origins[:, 0])]
    if not len(path):
        return np.zeros(len(xyz), bool), 0.0
    corner, far = path.min(axis=0) - reach, path.max(axis=0) + reach
    candidates &= ((xyz > corner) & (xyz < far)).all(axis=1)
    if not candidates.any():
        return candidates, 0.0
    boxes = _boxes(xyz[candidates])
    verdict = _in_free_space(xyz, origins, candidates, starts, again, boxes, voxel, reach, votes)
    return _with_outer_layer(xyz, windows, verdict, LAYER * voxel), float((verdict[candidates] > 0).mean())


def _with_outer_layer(xyz: F32, windows: I64, verdict: U8, reach: float) -> Bools:
    """(N,) the points in free space, and those in the open that lie within `reach` of one of the same window."""
    from scipy.spatial import cKDTree

    free = verdict == FREE
    index = np.flatnonzero((verdict == OPEN) & np.isin(windows, windows[free]))
    if not len(index):
        return free
    apart = 2 * reach  # a fourth axis, on which windows are no neighbours
    tree = cKDTree(np.column_stack([xyz[free], apart * windows[free]]))
    places = np.column_stack([xyz[index], apart * windows[index]])
    distance, _ = tree.query(places, distance_upper_bound=reach, workers=-1)
    free[index] = np.isfinite(distance)
    return free


def _boxes(xyz: F32) -> F64:
    """(B, 6) least and greatest corner of the blocks that hold points (N, 3)."""
    low, high = xyz.min(axis=0).astype(np.float64), xyz.max(axis=0).astype(np.float64) + 1e-3
    column = np.floor((xyz[:, :2] - low[:2]) / BLOCK).astype(np.int64)
    found = np.unique(column[:, 0] << 32 | column[:, 1])
    corner = low[:2] + BLOCK * np.column_stack([found >> 32, found & 0xFFFFFFFF])
    return np.column_stack(
        [corner, np.full(len(found), low[2]), np.minimum(corner + BLOCK, high[:2]), np.full(len(found), high[2])]
    )


@njit(cache=True, parallel=True)
def _in_free_space(
    xyz: F32,
    origins: F32,
    candidates: Bools,
    starts: I64,
    again: Bools,
    boxes: F64,
    voxel: float,
    reach: float,
    votes: int,
) -> U8:
    ends, spans = np.empty((len(starts) - 1, 6), np.float64), np.empty((len(starts) - 1, 6), np.float64)
    for w in prange(len(spans)):
        ends[w] = _span(xyz, starts[w], starts[w + 1], 0.0)
        spans[w] = _span(origins, starts[w], starts[w + 1], reach)
    out = np.zeros(len(xyz), np.uint8)
    for b in prange(len(boxes)):
        _carve(xyz, origins, candidates, starts, again, ends, spans, boxes[b], voxel, reach, votes, out)
    return out


@njit(cache=True)
def _span(places: F32, first: int, end: int, reach: float) -> F64:
    """Least and greatest corner of the box that holds all within `reach` of places."""
    span = np.array([np.inf, np.inf, np.inf, -np.inf, -np.inf, -np.inf])
    for i in range(first, end):
        if not math.isnan(places[i, 0]):
            for k in range(3):
                span[k] = min(span[k], places[i, k] - reach)
                span[k + 3] = max(span[k + 3], places[i, k] + reach)
    return span


@njit(cache=True)
def _carve(
    xyz: F32,
    origins: F32,
    candidates: Bools,
    starts: I64,
    again: Bools,
    ends: F64,
    spans: F64,
    box: F64,
    voxel: float,
    reach: float,
    votes: int,
    out: U8,
) -> None:
    """Mark in `out` which of the candidates that lie in the box are `FREE` or `OPEN`."""
    corner = box[:3] - HALO * voxel
    shape = np.empty(3, np.int64)
    for k in range(3):
        shape[k] = int(math.ceil((box[k + 3] - corner[k]) / voxel)) + HALO
    far = corner + shape * voxel
    size = shape[0] * shape[1] * shape[2]
    passes, hits = np.zeros(size, np.uint16), np.zeros(size, np.uint16)
    through, inside = np.zeros(size, np.uint16), np.zeros(size, np.uint16)  # passes and hits of the voxel alone
    hit_in, inside_in = np.full(size, -1, np.int32), np.full(size, -1, np.int32)
    rays = np.zeros(size, np.int32)  # through the voxel, counted on from `RAYS` + 1 times the window
    for w in range(len(spans)):
        if again[w]:
            _vote(xyz, candidates, box, corner, shape, voxel, votes, passes, hits, through, inside, out)
            for counts in (passes, hits, through, inside):
                counts[:] = 0
        for i in range(starts[w], starts[w + 1] if _overlap(ends[w], corner, far) else starts[w]):
            _hit(xyz, i, corner, far, shape, voxel, w, hit_in, hits, inside_in, inside)
        for i in range(starts[w], starts[w + 1] if _overlap(spans[w], corner, far) else starts[w]):
            _pass(xyz, origins, i, corner, far, shape, voxel, reach, w, hit_in, rays, passes, through)
    _vote(xyz, candidates, box, corner, shape, voxel, votes, passes, hits, through, inside, out)


@njit(cache=True)
def _vote(
    xyz: F32,
    candidates: Bools,
    box: F64,
    corner: F64,
    shape: I64,
    voxel: float,
    votes: int,
    passes: npt.NDArray[np.uint16],
    hits: npt.NDArray[np.uint16],
    through: npt.NDArray[np.uint16],
    inside: npt.NDArray[np.uint16],
    out: U8,
) -> None:
    """What the counts say of each point in the box, kept in `out` if it is more than was said before."""
    for i in range(len(xyz)):
        if not candidates[i] or out[i] == FREE or xyz[i, 0] < box[0] or xyz[i, 1] < box[1] or xyz[i, 2] < box[2]:
            continue
        if xyz[i, 0] >= box[3] or xyz[i, 1] >= box[4] or xyz[i, 2] >= box[5]:
            continue
        x, y, z = _voxel(xyz, i, corner, voxel)
        at = (x * shape[1] + y) * shape[2] + z
        if hits[at] <= passes[at] and _least(passes, x, y, z, shape) >= votes:
            out[i] = FREE
        elif through[at] >= votes and 2 * inside[at] <= through[at]:
            out[i] = OPEN
        elif out[i] == 0 and hits[at] + passes[at] >= votes:
            out[i] = STANDS


@njit(cache=True)
def _voxel(xyz: F32, i: int, corner: F64, voxel: float) -> tuple[int, int, int]:
    """The voxel of point i: x, y and z."""
    return (
        int((xyz[i, 0] - corner[0]) / voxel),
        int((xyz[i, 1] - corner[1]) / voxel),
        int((xyz[i, 2] - corner[2]) / voxel),
    )


@njit(cache=True)
def _overlap(span: F64, corner: F64, far: F64) -> bool:
    """Whether two boxes overlap."""
    apart = False
    for k in range(3):
        apart |= span[k] > far[k] or span[k + 3] < corner[k]
    return not apart


@njit(cache=True)
def _least(values: npt.NDArray[np.uint16], x: int, y: int, z: int, shape: I64) -> int:
    """The least value of a voxel and its 26 neighbours."""
    least = values[(x * shape[1] + y) * shape[2] + z]
    for jx in range(x - 1, x + 2):
        for jy in range(y - 1, y + 2):
            for jz in range(z - 1, z + 2):
                least = min(least, values[(jx * shape[1] + jy) * shape[2] + jz])
    return least


@njit(cache=True)
def _hit(
    xyz: F32,
    i: int,
    corner: F64,
    far: F64,
    shape: I64,
    voxel: float,
    window: int,
    hit_in: I32,
    hits: npt.NDArray[np.uint16],
    inside_in: I32,
    inside: npt.NDArray[np.uint16],
) -> None:
    """Mark the voxel of a return and its neighbours."""
    for k in range(3):
        if xyz[i, k] < corner[k] or xyz[i, k] >= far[k]:
            return
    x, y, z = _voxel(xyz, i, corner, voxel)
    own = (x * shape[1] + y) * shape[2] + z
    if inside_in[own] == window:  # and so are its neighbours
        return
    inside_in[own] = window
    inside[own] += 1
    for jx in range(max(x - 1, 0), min(x + 2, shape[0])):
        for jy in range(max(y - 1, 0), min(y + 2, shape[1])):
            for jz in range(max(z - 1, 0), min(z + 2, shape[2])):
                at = (jx * shape[1] + jy) * shape[2] + jz
                if hit_in[at] != window:
                    hit_in[at] = window
                    hits[at] += 1


@njit(cache=True)
def _pass(
    xyz: F32,
    origins: F32,
    i: int,
    corner: F64,
    far: F64,
    shape: I64,
    voxel: float,
    reach: float,
    window: int,
    hit_in: I32,
    rays: I32,
    passes: npt.NDArray[np.uint16],
    through: npt.NDArray[np.uint16],
) -> None:
    """Walk along a ray from voxel to voxel (Amanatides and Woo, 1987), up to the last before its return."""
    for k in range(3):  # most rays are nowhere near a block
        if max(origins[i, k], xyz[i, k]) < corner[k] or min(origins[i, k], xyz[i, k]) >= far[k]:
            return
    o = origins[i, 0], origins[i, 1], origins[i, 2]
    dx, dy, dz = float(xyz[i, 0] - o[0]), float(xyz[i, 1] - o[1]), float(xyz[i, 2] - o[2])
    r = math.sqrt(dx * dx + dy * dy + dz * dz)
    begin, end = 0.0, min(r - voxel, reach)
    if not end > voxel:  # nor where the origin isn't known
        return
    direction = (dx / r, dy / r, dz / r)
    for k in range(3):  # what of it lies in the block
        d = direction[k]
        if abs(d) < 1e-9:
            if o[k] < corner[k] or o[k] >= far[k]:
                return
        else:
            a, b = (corner[k] - o[k]) / d, (far[k] - o[k]) / d
            begin, end = max(begin, min(a, b)), min(end, max(a, b))
    begin += 1e-4
    if begin >= end:
        return
    x, y, z = (
        (o[0] + begin * direction[0] - corner[0]) / voxel,
        (o[1] + begin * direction[1] - corner[1]) / voxel,
        (o[2] + begin * direction[2] - corner[2]) / voxel,
    )
    ix, iy, iz = int(x), int(y), int(z)
    step_x, step_y, step_z = (1 if dx > 0 else -1), (1 if dy > 0 else -1), (1 if dz > 0 else -1)
    each_x = voxel / max(abs(direction[0]), 1e-9)
    each_y = voxel / max(abs(direction[1]), 1e-9)
    each_z = voxel / max(abs(direction[2]), 1e-9)
    next_x = begin + ((ix + 1 - x) if dx > 0 else (x - ix)) * each_x
    next_y = begin + ((iy + 1 - y) if dy > 0 else (y - iy)) * each_y
    next_z = begin + ((iz + 1 - z) if dz > 0 else (z - iz)) * each_z
    along, none = begin, window * (RAYS + 1)
    while along < end and 0 <= ix < shape[0] and 0 <= iy < shape[1] and 0 <= iz < shape[2]:
        at = (ix * shape[1] + iy) * shape[2] + iz
        if rays[at] < none + RAYS:
            rays[at] = max(rays[at], none) + 1
            if rays[at] == none + RAYS:
                through[at] += 1
                if hit_in[at] != window:
                    passes[at] += 1
        if next_x < next_y and next_x < next_z:
            along, next_x, ix = next_x, next_x + each_x, ix + step_x
        elif next_y < next_z:
            along, next_y, iy = next_y, next_y + each_y, iy + step_y
        else:
            along, next_z, iz = next_z, next_z + each_z, iz + step_z
