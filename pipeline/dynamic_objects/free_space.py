"""Free space detection by ray casting in a voxel grid: points in free space belong to objects that moved.

A ray proves that space is free between the scanner and its return. Space is divided into voxels, time into windows of
about one turn of a spinning scanner. In a window, a voxel is *hit* if a return lies in it or in a neighbour; else it is
*passed* if enough rays crossed it to hit an object of its size. A voxel is free if it and all its neighbours were
passed in several windows, and it was rarely hit. Voxels that no ray has seen from behind are never free: roads and
walls are kept at any angle of incidence, and for pose errors below a voxel. Thin and semi-transparent objects are kept
because they are hit repeatedly. Each pass of the scanner is evaluated separately: an object that was there in one pass
and not in the next has moved. The outermost layer of an object borders on voxels that no ray passed (the road below,
the sky above): its points are removed with the rest of the object if rays passed their own voxel.

Rays are traced exactly, each from the scanner's position at its time, so any scanner that sees a location more than
once is supported: a spinning one in every turn, a profile scanner in every pass.

After DUFOMap (Duberg et al., "DUFOMap: Efficient Dynamic Awareness Mapping", RA-L 2024), with votes over windows
instead of a single observation. Import this module lazily: it loads numba.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from scan2sim.pipeline.core.types import F32, F64, I32, I64, U8, Bools

BLOCK_M = 32.0
"""Side of the square blocks that space is processed in, one per thread; bounds memory."""
MIN_RAYS = 2
"""Rays through a voxel in one window that count as a pass: fewer could miss a narrower object."""
FREE, OPEN, STATIC = 1, 2, 3
"""State of a point: its voxel and all neighbours are free; only its voxel is, passed twice as often as hit; observed as
often, but neither. 0: observed too rarely."""
OUTER_LAYER_VOXELS = 1.5
"""Open points within this distance of a free point of the same window belong to the same object."""
PASS_GAP_WINDOWS = 100
"""Number of windows without a point after which a new pass of the scanner begins."""
HALO_VOXELS = 2
"""Margin around a block: neighbours of its voxels, and their neighbours."""


def in_free_space(
    xyz: F32,
    origins: F32,
    windows: I64,
    *,
    voxel: float,
    max_range: float,
    votes: int,
    high: float,
) -> tuple[Bools, float]:
    """(N,) bool, True for points in free space; and the fraction of candidate points that were observed often enough.

    Args:
        xyz: (N, 3) local metres, in order of time.
        origins: (N, 3) position of the scanner at each point's time; NaN if unknown.
        windows: (N,) number of each point's time window, ascending.
        voxel: voxel size in metres; poses must be more accurate than this.
        max_range: maximum length of rays, metres: beyond it, angular errors may exceed a voxel.
        votes: number of windows in which a voxel must have been passed.
        high: height (local z, metres) below which points are classified.
    """
    first = np.flatnonzero(np.diff(windows, prepend=windows[:1] - 1))
    new_pass = np.append(False, np.diff(windows[first]) > PASS_GAP_WINDOWS)
    starts = np.append(first, len(xyz))
    candidates = xyz[:, 2] < high
    path = origins[np.isfinite(origins[:, 0])]
    if not len(path):
        return np.zeros(len(xyz), bool), 0.0
    corner, far = path.min(axis=0) - max_range, path.max(axis=0) + max_range
    candidates &= ((xyz > corner) & (xyz < far)).all(axis=1)
    if not candidates.any():
        return candidates, 0.0
    boxes = _boxes(xyz[candidates])
    state = _in_free_space(xyz, origins, candidates, starts, new_pass, boxes, voxel, max_range, votes)
    return _with_outer_layer(xyz, windows, state, OUTER_LAYER_VOXELS * voxel), float((state[candidates] > 0).mean())


def _with_outer_layer(xyz: F32, windows: I64, state: U8, max_distance: float) -> Bools:
    """(N,) bool, True for free points, and for open points within `max_distance` of a free one of the same window."""
    from scipy.spatial import cKDTree

    free = state == FREE
    index = np.flatnonzero((state == OPEN) & np.isin(windows, windows[free]))
    if not len(index):
        return free
    apart = 2 * max_distance  # scale of a fourth axis that separates the windows
    tree = cKDTree(np.column_stack([xyz[free], apart * windows[free]]))
    places = np.column_stack([xyz[index], apart * windows[index]])
    distance, _ = tree.query(places, distance_upper_bound=max_distance, workers=-1)
    free[index] = np.isfinite(distance)
    return free


def _boxes(xyz: F32) -> F64:
    """Bounds (B, 6) (minimum, maximum corner) of the blocks that contain points (N, 3)."""
    low, high = xyz.min(axis=0).astype(np.float64), xyz.max(axis=0).astype(np.float64) + 1e-3
    column = np.floor((xyz[:, :2] - low[:2]) / BLOCK_M).astype(np.int64)
    found = np.unique(column[:, 0] << 32 | column[:, 1])
    corner = low[:2] + BLOCK_M * np.column_stack([found >> 32, found & 0xFFFFFFFF])
    return np.column_stack(
        [corner, np.full(len(found), low[2]), np.minimum(corner + BLOCK_M, high[:2]), np.full(len(found), high[2])]
    )


@njit(cache=True, parallel=True)
def _in_free_space(
    xyz: F32,
    origins: F32,
    candidates: Bools,
    starts: I64,
    new_pass: Bools,
    boxes: F64,
    voxel: float,
    max_range: float,
    votes: int,
) -> U8:
    ends, spans = np.empty((len(starts) - 1, 6), np.float64), np.empty((len(starts) - 1, 6), np.float64)
    for w in prange(len(spans)):
        ends[w] = _span(xyz, starts[w], starts[w + 1], 0.0)
        spans[w] = _span(origins, starts[w], starts[w + 1], max_range)
    out = np.zeros(len(xyz), np.uint8)
    for b in prange(len(boxes)):
        _carve(xyz, origins, candidates, starts, new_pass, ends, spans, boxes[b], voxel, max_range, votes, out)
    return out


@njit(cache=True)
def _span(places: F32, first: int, end: int, margin: float) -> F64:
    """Bounding box (minimum, maximum corner) of positions, dilated by `margin`."""
    span = np.array([np.inf, np.inf, np.inf, -np.inf, -np.inf, -np.inf])
    for i in range(first, end):
        if not math.isnan(places[i, 0]):
            for k in range(3):
                span[k] = min(span[k], places[i, k] - margin)
                span[k + 3] = max(span[k + 3], places[i, k] + margin)
    return span


@njit(cache=True)
def _carve(
    xyz: F32,
    origins: F32,
    candidates: Bools,
    starts: I64,
    new_pass: Bools,
    ends: F64,
    spans: F64,
    box: F64,
    voxel: float,
    max_range: float,
    votes: int,
    out: U8,
) -> None:
    """Write the state of the candidates inside the box to `out`."""
    corner = box[:3] - HALO_VOXELS * voxel
    shape = np.empty(3, np.int64)
    for k in range(3):
        shape[k] = int(math.ceil((box[k + 3] - corner[k]) / voxel)) + HALO_VOXELS
    far = corner + shape * voxel
    size = shape[0] * shape[1] * shape[2]
    passes, hits = np.zeros(size, np.uint16), np.zeros(size, np.uint16)
    through, inside = (
        np.zeros(size, np.uint16),
        np.zeros(size, np.uint16),
    )  # passes and hits of the voxel without its neighbours
    hit_in, inside_in = np.full(size, -1, np.int32), np.full(size, -1, np.int32)
    rays = np.zeros(size, np.int32)  # rays through the voxel, with an offset of (`MIN_RAYS` + 1) x window
    for w in range(len(spans)):
        if new_pass[w]:
            _vote(xyz, candidates, box, corner, shape, voxel, votes, passes, hits, through, inside, out)
            for counts in (passes, hits, through, inside):
                counts[:] = 0
        for i in range(starts[w], starts[w + 1] if _overlap(ends[w], corner, far) else starts[w]):
            _hit(xyz, i, corner, far, shape, voxel, w, hit_in, hits, inside_in, inside)
        for i in range(starts[w], starts[w + 1] if _overlap(spans[w], corner, far) else starts[w]):
            _pass(xyz, origins, i, corner, far, shape, voxel, max_range, w, hit_in, rays, passes, through)
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
    """Classify the points in the box by the counts of a pass; `out` keeps the strongest state of all passes."""
    for i in range(len(xyz)):
        if not candidates[i] or out[i] == FREE or xyz[i, 0] < box[0] or xyz[i, 1] < box[1] or xyz[i, 2] < box[2]:
            continue
        if xyz[i, 0] >= box[3] or xyz[i, 1] >= box[4] or xyz[i, 2] >= box[5]:
            continue
        x, y, z = _voxel(xyz, i, corner, voxel)
        at = (x * shape[1] + y) * shape[2] + z
        if hits[at] <= passes[at] and _min_of_neighbours(passes, x, y, z, shape) >= votes:
            out[i] = FREE
        elif through[at] >= votes and 2 * inside[at] <= through[at]:
            out[i] = OPEN
        elif out[i] == 0 and hits[at] + passes[at] >= votes:
            out[i] = STATIC


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
def _min_of_neighbours(values: npt.NDArray[np.uint16], x: int, y: int, z: int, shape: I64) -> int:
    """Minimum over a voxel and its 26 neighbours."""
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
    """Count a hit of the voxel of a return and its neighbours."""
    for k in range(3):
        if xyz[i, k] < corner[k] or xyz[i, k] >= far[k]:
            return
    x, y, z = _voxel(xyz, i, corner, voxel)
    own = (x * shape[1] + y) * shape[2] + z
    if inside_in[own] == window:  # already counted in this window, with its neighbours
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
    max_range: float,
    window: int,
    hit_in: I32,
    rays: I32,
    passes: npt.NDArray[np.uint16],
    through: npt.NDArray[np.uint16],
) -> None:
    """Traverse the voxels of a ray (Amanatides and Woo, 1987) up to the last one before its return."""
    for k in range(3):  # fast rejection of rays that don't touch the block
        if max(origins[i, k], xyz[i, k]) < corner[k] or min(origins[i, k], xyz[i, k]) >= far[k]:
            return
    o = origins[i, 0], origins[i, 1], origins[i, 2]
    dx, dy, dz = float(xyz[i, 0] - o[0]), float(xyz[i, 1] - o[1]), float(xyz[i, 2] - o[2])
    r = math.sqrt(dx * dx + dy * dy + dz * dz)
    begin, end = 0.0, min(r - voxel, max_range)
    if not end > voxel:  # also False if the origin is NaN
        return
    direction = (dx / r, dy / r, dz / r)
    for k in range(3):  # clip the ray to the block
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
    along, none = begin, window * (MIN_RAYS + 1)
    while along < end and 0 <= ix < shape[0] and 0 <= iy < shape[1] and 0 <= iz < shape[2]:
        at = (ix * shape[1] + iy) * shape[2] + iz
        if rays[at] < none + MIN_RAYS:
            rays[at] = max(rays[at], none) + 1
            if rays[at] == none + MIN_RAYS:
                through[at] += 1
                if hit_in[at] != window:
                    passes[at] += 1
        if next_x < next_y and next_x < next_z:
            along, next_x, ix = next_x, next_x + each_x, ix + step_x
        elif next_y < next_z:
            along, next_y, iy = next_y, next_y + each_y, iy + step_y
        else:
            along, next_z, iz = next_z, next_z + each_z, iz + step_z
