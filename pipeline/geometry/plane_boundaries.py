"""How far planes reach: straight sides around each plane's points, and what is beyond. Import late: it loads numba.

Sides are traced around the mask of a plane's points, then each is laid through the outermost of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.spatial import cKDTree

from scan2sim.pipeline.core.types import F32, F64, I32, I64, Bools
from scan2sim.pipeline.geometry.planes import Planes
from scan2sim.pipeline.geometry.sorting import ordered
from scan2sim.pipeline.steps.voxel import voxel_groups

LOOSE = 0.4
"""Voxels by which a single point may miss its plane, at least: several make a thinned one."""
CELLS = 2
"""Cells of a mask in a voxel."""
BRIDGED = 2.5
"""Voxels: gaps of twice as much are closed, as `trim` leaves them closed."""
STRAIGHT = 0.8
"""Voxels by which a side may miss the mask's outline."""
SHORTEST = 3.0
"""Voxels of a side that is fitted."""
HOLE = 10.0
"""Square voxels of a hole that has sides."""
BIN = 1.0
"""Voxels of a side, whose outermost point is looked for."""
DEEP = 2.0
"""Voxels inside a side, and one outside, in which it is looked for."""
FILLED = 3
"""Points of such a bin, at least."""
SLOPE = 0.2
"""By which a side is turned at most, when it is fitted, of at least so many bins:"""
SLOPED = 6
TIGHT = 0.4
"""Voxels by which four of five bins miss it at most."""
SAME_WAY = float(np.cos(np.radians(15.0)))
"""Turn below which there is no corner."""
SURE = 0.5
"""Share of a side behind which the same plane has to be."""
LONG = 10.0
"""Voxels of a side that a surface ends at: what is round, or small, has short ones."""
AROUND = ((1.9, 1.5, 1.2), (1.9, 0.0, 1.2), (1.9, -1.5, 1.2), (1.9, -3.0, 1.2),
          (0.0, 2.2, 1.2), (0.0, -2.2, 1.2), (0.0, -4.0, 1.2))  # fmt: skip
"""Voxels out of a side, in front of its plane, and radius, of places that are empty where a surface ends: it neither
goes on nor turns."""
FOREIGN = 1.9
"""Voxels around a side where no other class is."""
PARALLEL = float(np.cos(np.radians(10.0)))
STEP_LEAST, STEP_MOST = 0.4, 4.0
"""Voxels between two parallel planes of which one ends before the other: reveals, ledges, parapets."""
REACH = 3.5
"""Voxels beyond a side in which its surface is cut off: `trim` leaves two and a half."""
RIM = 1.2
"""Voxels of such a face behind whose front no plane is: rims of roofs, parapets, sills."""
SPAN = 0.8
"""Voxels between the points that stand for a step's face."""


Line = tuple[F64, F64, bool]
"""A place (2,) on it, its unit direction (2,), and whether the outermost points told it."""


@dataclass(frozen=True)
class Sides:
    """Straight sides of planes' extents.

    Attributes:
        plane: (S,) whose.
        start, end: (S, 3) local metres, on the plane; along a ring what is filled lies to the left.
        outward: (S, 3) unit, in the plane.
        fitted: (S,) bool, laid through the outermost points (short ones, and those in gaps, aren't).
        hole: (S,) bool, around a hole.
    """

    plane: I32
    start: F64
    end: F64
    outward: F64
    fitted: Bools
    hole: Bools

    def __len__(self) -> int:
        return len(self.plane)

    @property
    def planes(self) -> Planes:
        """The planes through the sides, square to their own."""
        return Planes(self.outward, (self.outward * self.start).sum(axis=1))

    def take(self, index: npt.NDArray[np.integer] | Bools) -> Sides:
        """Some of them."""
        return Sides(*(getattr(self, name)[index] for name in self.__dataclass_fields__))

    def along(self, step: float) -> tuple[F64, I32]:
        """Places (N, 3) every `step` metres, and whose side's (N,)."""
        length = np.linalg.norm(self.end - self.start, axis=1)
        count = np.maximum(1, np.ceil(length / step)).astype(int)
        of = np.repeat(np.arange(len(self)), count).astype(np.int32)
        share = (np.arange(len(of)) - np.repeat(np.cumsum(count) - count, count) + 0.5) / count[of]
        return self.start[of] + share[:, None] * (self.end - self.start)[of], of


def members(xyz: F32, planes: Planes, thin: F32, which: I32, voxel: float, tolerance: float) -> I32:
    """(N,) the plane of each of a cloud's points, -1 for none.

    That is its voxel's, else of those of the points around it the one that it lies on best.

    Args:
        xyz: (N, 3) local metres.
        planes: of the thinned points.
        thin: (M, 3) one a voxel, in the order of `voxel_groups`.
        which: (M,) their planes.
        voxel: metres.
        tolerance: metres by which a thinned point may miss its plane; a single one may by `LOOSE` voxels.
    """
    tolerance = max(tolerance, LOOSE * voxel)
    own = np.full(len(xyz), -1, np.int32)
    on = np.flatnonzero(which >= 0)
    if not len(on):
        return own
    order, starts = voxel_groups(xyz, voxel)
    own[order] = np.repeat(which, np.diff(np.append(starts, len(order))))
    own[(own >= 0) & (np.abs(planes.beyond(xyz, own)) > tolerance)] = -1
    rest = np.flatnonzero(own < 0)
    _, at = cKDTree(thin[on]).query(xyz[rest], 4, distance_upper_bound=2 * voxel, workers=-1)
    best = np.full(len(rest), tolerance)
    for column in np.append(which[on], np.int32(-1))[at].T:
        given = np.flatnonzero(column >= 0)
        off = np.abs(planes.beyond(xyz[rest[given]], column[given]))
        better = off < best[given]
        own[rest[given[better]]], best[given[better]] = column[given[better]], off[better]
    return own


def sides(xyz: F32, own: I32, planes: Planes, voxel: float) -> Sides:
    """The sides of all planes' extents.

    Args:
        xyz: (N, 3) local metres, the whole cloud.
        own: (N,) each point's plane, -1 for none.
        planes: of the points.
        voxel: metres.
    """
    order, of_plane = ordered(own.astype(np.int64) + 1)
    first = np.searchsorted(of_plane, np.arange(len(planes) + 1) + 1)
    rows: list[tuple[int, F64, F64, F64, bool, bool]] = []
    for p in range(len(planes)):
        points = xyz[order[first[p] : first[p + 1]]].astype(np.float64)
        if len(points) < FILLED:
            continue
        axes = _axes(planes.normal[p])
        flat = points @ axes.T
        for ring, hole in _rings(flat, voxel):
            lines = [_fit(flat, a, b, voxel) for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True)]
            ring, lines = _without_chamfers(ring, lines, voxel)
            corners = np.array([_corner(lines[k - 1], lines[k], ring[k], voxel) for k in range(len(ring))])
            for k, (_, along, fitted) in enumerate(lines):
                a, b = corners[k], corners[(k + 1) % len(ring)]
                if (b - a) @ along < voxel / 4:
                    continue
                outward = np.array([along[1], -along[0]]) @ axes
                place = planes.normal[p] * planes.offset[p]
                rows.append((p, a @ axes + place, b @ axes + place, outward, fitted, hole))
    if not rows:
        none = np.zeros((0, 3))
        return Sides(np.zeros(0, np.int32), none, none, none, np.zeros(0, bool), np.zeros(0, bool))
    of, starts, ends, out, fits, holes = zip(*rows, strict=True)
    return Sides(
        np.array(of, np.int32), np.array(starts), np.array(ends), np.array(out), np.array(fits), np.array(holes)
    )


def steps(
    found: Sides, planes: Planes, thin: F32, which: I32, voxel: float, tolerance: float
) -> tuple[Planes, F64, I32]:
    """Faces between parallel planes of which the one in front ends: reveals of windows, ledges.

    Args:
        found: sides of the planes.
        planes: of the points.
        thin: (M, 3) the thinned points.
        which: (M,) their planes, -1 for none.
        voxel: metres.
        tolerance: metres by which points miss planes: what is twice as far behind is another plane.

    Returns:
        The faces' planes, square to both; points (M, 3) on them, and whose each is (M,).
    """
    none = Planes(np.zeros((0, 3)), np.zeros(0)), np.zeros((0, 3)), np.zeros(0, np.int32)
    on = np.flatnonzero(which >= 0)
    found = found.take(found.fitted)
    if not len(found) or not len(on):
        return none
    places, of = found.along(voxel)
    normal = planes.normal[found.plane]
    tree, plane = cKDTree(thin[on]), which[on]
    behind = np.full(len(places), -1, np.int32)
    for depth in np.arange(STEP_LEAST, STEP_MOST, 0.8) * voxel:
        probe = places + 1.5 * voxel * found.outward[of] - depth * normal[of]
        _, at = tree.query(probe, distance_upper_bound=1.2 * voxel, workers=-1)
        back = np.append(plane, np.int32(-1))[at]
        ok = (back >= 0) & (back != found.plane[of]) & (behind < 0)
        ok &= (planes.normal[back] * normal[of]).sum(axis=1) > PARALLEL
        down = planes.beyond(places, back)
        ok &= (down > max(STEP_LEAST * voxel, 2 * tolerance)) & (down < STEP_MOST * voxel)
        behind[ok] = back[ok]
    rim = _rims(places, of, found, normal, thin[which < 0], voxel)
    normals: list[F64] = []
    offsets: list[float] = []
    points: list[F64] = []
    whose: list[I32] = []
    for side in range(len(found)):
        here = behind[of == side]
        back = int(np.bincount(here + 1, minlength=2)[1:].argmax())
        outward = found.outward[side]
        line = places[of == side]
        if (here == back).mean() >= SURE:
            depth = float((line @ planes.normal[back] - planes.offset[back]).mean())
        elif rim[of == side].mean() >= SURE:
            depth = RIM * voxel
        else:
            continue
        rungs = (np.arange(max(1, round(depth / voxel / SPAN))) + 0.5) * depth / max(1, round(depth / voxel / SPAN))
        length = np.linalg.norm(found.end[side] - found.start[side])
        share = np.linspace(0, 1, max(2, int(length / (SPAN * voxel))))[:, None]
        dense = found.start[side] + share * (found.end[side] - found.start[side])
        face = (dense[None] - rungs[:, None, None] * normal[side]).reshape(-1, 3)
        points.append(face)
        whose.append(np.full(len(face), len(normals), np.int32))
        normals.append(outward)
        offsets.append(float(outward @ found.start[side]))
    if not normals:
        return none
    return Planes(np.array(normals), np.array(offsets)), np.concatenate(points), np.concatenate(whose)


def _rims(places: F64, of: I32, found: Sides, normal: F64, loose: F32, voxel: float) -> Bools:
    """(N,) whether points that are on no plane lie straight behind places of sides: a face too narrow for a plane."""
    if not len(loose):
        return np.zeros(len(places), bool)
    _, at = cKDTree(loose).query(places - 0.8 * RIM * voxel * normal[of], distance_upper_bound=0.8 * RIM * voxel)
    near = np.flatnonzero(at < len(loose))
    apart = loose[at[near]] - places[near]
    out, down = (apart * found.outward[of[near]]).sum(axis=1), -(apart * normal[of[near]]).sum(axis=1)
    rim = np.zeros(len(places), bool)
    rim[near] = (np.abs(out) < 0.3 * voxel) & (down > 0.4 * voxel)
    return rim


def free(
    found: Sides, planes: Planes, thin: F32, which: I32, others: F32, border: F32, voxel: float
) -> tuple[F64, I32]:
    """Places (N, 3) along sides beyond which nothing is, and whose side's (N,).

    Args:
        found: sides of the planes.
        planes: of the points.
        thin: (M, 3) the thinned points of the planes' class.
        which: (M,) their planes, -1 for none.
        others: (K, 3) those of all other classes: a wall ends in the ground without an edge of its own.
        border: (B, 3) vertices on the mesh's border: nothing ends where the surface goes on.
        voxel: metres.
    """
    places, of = found.along(voxel)
    long = np.linalg.norm(found.end - found.start, axis=1) >= LONG * voxel
    ends = (found.fitted & long)[of]
    places, of = places[ends], of[ends]
    if not len(places):
        return places, of
    empty = np.isfinite(cKDTree(border).query(places, distance_upper_bound=REACH * voxel, workers=-1)[0])
    tree = cKDTree(np.concatenate([thin, others]))
    for out, depth, radius in AROUND:
        probe = places + voxel * (out * found.outward[of] + depth * planes.normal[found.plane[of]])
        near, _ = tree.query(probe, distance_upper_bound=radius * voxel, workers=-1)
        empty &= ~np.isfinite(near)
    if len(others):
        near, _ = cKDTree(others).query(places, distance_upper_bound=FOREIGN * voxel, workers=-1)
        empty &= ~np.isfinite(near)
    on = np.flatnonzero(which >= 0)
    _, at = cKDTree(thin[on]).query(places, 12, distance_upper_bound=1.5 * voxel, workers=-1)
    plane = np.append(which[on], np.int32(-1))[at]
    mine = found.plane[of][:, None]
    turned = np.abs(np.einsum("nkj,nj->nk", planes.normal[plane], planes.normal[mine[:, 0]])) < PARALLEL
    empty &= ~((plane >= 0) & (plane != mine) & turned).any(axis=1)
    return places[empty], of[empty]


def ended(
    vertices: F64, own: I32, planes: Planes, found: Sides, places: F64, of: I32, points: F32, voxel: float
) -> I32:
    """(V,) planes of a mesh's vertices, those beyond free sides of planes `len(planes) + side`.

    Args:
        vertices: (V, 3) local metres.
        own: (V,) their planes, -1 for none.
        planes, found: and their sides.
        places, of: what `free` told.
        points: (M, 3) thinned points of the class.
        voxel: metres.
    """
    own = own.copy()
    if not len(places):
        return own
    _, at = cKDTree(places).query(vertices, distance_upper_bound=REACH * voxel, workers=-1)
    near = np.flatnonzero(at < len(places))
    side = of[at[near]]
    plane = found.plane[side]
    loose = (own[near] < 0) | (own[near] == plane)
    near, side, plane = near[loose], side[loose], plane[loose]
    out = ((vertices[near] - found.start[side]) * found.outward[side]).sum(axis=1)
    off = planes.beyond(vertices[near], plane)
    far, _ = cKDTree(points).query(vertices[near], distance_upper_bound=1.2 * voxel, workers=-1)
    inner = (out <= 0) & (own[near] < 0) & (np.abs(off) < voxel)
    own[near[inner]] = plane[inner]
    gone = (out > 0) | (~np.isfinite(far) & (np.abs(off) > voxel))
    own[near[gone]] = (len(planes) + side[gone]).astype(np.int32)
    return own


def _axes(normal: F64) -> F64:
    """(2, 3) unit axes in a plane, counter-clockwise seen against its normal: level, and up."""
    level = np.cross([0.0, 0.0, 1.0], normal)
    level = level / np.linalg.norm(level) if np.linalg.norm(level) > 0.1 else np.array([1.0, 0.0, 0.0])
    level -= normal * (normal @ level)
    level /= np.linalg.norm(level)
    return np.stack([level, np.cross(normal, level)])


def _rings(flat: F64, voxel: float) -> list[tuple[F64, bool]]:
    """Corners (K, 2) of rings around points (N, 2), what is filled to the left; and whether it is a hole's."""
    cell = voxel / CELLS
    margin = int(np.ceil(BRIDGED * CELLS)) + 2
    low = np.floor(flat.min(axis=0) / cell).astype(int) - margin
    at = np.floor(flat / cell).astype(int) - low
    mask = np.zeros((at[:, 1].max() + margin + 1, at[:, 0].max() + margin + 1), np.uint8)
    mask[at[:, 1], at[:, 0]] = 1
    radius = int(round(BRIDGED * CELLS))
    square = cv2.getStructuringElement(cv2.MORPH_RECT, (2 * radius + 1, 2 * radius + 1))
    mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, square).astype(np.uint8)
    contours, tree = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    rings = []
    for contour, links in zip(contours, tree[0] if tree is not None else (), strict=True):
        hole = bool(links[3] >= 0)
        if len(contour) < 6 or cv2.contourArea(contour) < (HOLE if hole else 1.0) * CELLS**2:
            continue
        ring = _turning(cv2.approxPolyDP(contour, STRAIGHT * CELLS, closed=True)[:, 0])
        if len(ring) < 3:
            continue
        x, y = ring[:, 0].astype(float), ring[:, 1].astype(float)
        area = (x * np.roll(y, -1) - np.roll(x, -1) * y).sum()
        if (area > 0) == hole:
            ring = ring[::-1]
        rings.append(((ring + low + 0.5) * cell, hole))
    return rings


def _turning(ring: npt.NDArray[np.integer]) -> npt.NDArray[np.integer]:
    """A ring (K, 2) without the corners at which it hardly turns."""
    while len(ring) > 3:
        way = (np.roll(ring, -1, axis=0) - ring).astype(float)
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        same = (way * np.roll(way, 1, axis=0)).sum(axis=1)
        if same.max() < SAME_WAY:
            break
        ring = np.delete(ring, int(same.argmax()), axis=0)
    return ring


def _fit(flat: F64, a: F64, b: F64, voxel: float) -> Line:
    """A place on the side from `a` to `b`, its direction, and whether the outermost points told it."""
    length = float(np.linalg.norm(b - a))
    along = (b - a) / max(length, 1e-9)
    if length < SHORTEST * voxel:
        return (a + b) / 2, along, False
    out = np.array([along[1], -along[0]])
    count, far = _outermost(flat, a, along, length, max(3, int(length / (BIN * voxel))), -DEEP * voxel, voxel)
    bins = len(count)
    good = count >= FILLED
    if good.sum() < max(3, bins // 2):
        return (a + b) / 2, along, False
    # n points spread over a bin leave a gap of the n-th part of it, in the mean
    reach = far[good] + (far[good] + DEEP * voxel) / count[good]
    where = (np.flatnonzero(good) + 0.5) / bins * length
    slope = 0.0
    if len(where) >= SLOPED:
        i, j = np.triu_indices(len(where), 1)
        slope = float(np.median((reach[j] - reach[i]) / (where[j] - where[i])))
    if abs(slope) > SLOPE:
        return (a + b) / 2, along, False
    level = float(np.median(reach - slope * where))
    turned = along + slope * out
    turned /= np.linalg.norm(turned)
    miss = np.quantile(np.abs(reach - slope * where - level), 0.8)
    return a + level * out, turned, bool(miss < TIGHT * voxel)


@njit(cache=True)
def _outermost(flat: F64, start: F64, along: F64, length: float, bins: int, low: float, high: float) -> tuple[I64, F64]:
    """Number (B,) and greatest distance (B,) to the right of a line, of points (N, 2) in each of its parts.

    Points count that are between `low` and `high` metres to its right.
    """
    count, far = np.zeros(bins, np.int64), np.full(bins, -np.inf)
    for i in range(len(flat)):
        x, y = flat[i, 0] - start[0], flat[i, 1] - start[1]
        t, s = x * along[0] + y * along[1], x * along[1] - y * along[0]
        if 0 < t < length and low < s < high:
            k = min(int(t / length * bins), bins - 1)
            count[k] += 1
            far[k] = max(far[k], s)
    return count, far


def _without_chamfers(ring: F64, lines: list[Line], voxel: float) -> tuple[F64, list[Line]]:
    """A ring without the short sides that closing has put across its corners."""
    length = np.linalg.norm(np.roll(ring, -1, axis=0) - ring, axis=1)
    count, kept = len(ring), list(range(len(ring)))
    places = ring.copy()
    for k in range(count):
        before, after = lines[k - 1], lines[(k + 1) % count]
        if lines[k][2] or not (before[2] and after[2]) or length[k] > 2 * BRIDGED * voxel or len(kept) <= 3:
            continue
        crossing = _intersection(before, after)
        middle = (ring[k] + ring[(k + 1) % count]) / 2
        if crossing is not None and np.linalg.norm(crossing - middle) < BRIDGED * voxel:
            kept.remove(k)
            places[(k + 1) % count] = crossing
    return places[kept], [lines[k] for k in kept]


def _intersection(before: Line, after: Line) -> F64 | None:
    """Where two lines intersect, None where they hardly do."""
    (p, d, _), (q, e, _) = before, after
    cross = d[0] * e[1] - d[1] * e[0]
    return p + ((q - p)[0] * e[1] - (q - p)[1] * e[0]) / cross * d if abs(cross) > 0.3 else None


def _corner(before: Line, after: Line, place: F64, voxel: float) -> F64:
    """Where two sides intersect near `place`; else the foot of `place` on the one that was fitted."""
    (p, d, one), (q, e, two) = before, after
    crossing = _intersection(before, after)
    if crossing is not None and np.linalg.norm(crossing - place) < 3 * voxel:
        return crossing
    if one or not two:
        return p + ((place - p) @ d) * d
    return q + ((place - q) @ e) * e
