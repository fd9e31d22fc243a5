"""Plane boundaries: straight sides around the points of each plane, and what lies beyond. Import lazily: loads numba.

Contours are traced around the mask of a plane's points; then each side is fitted to the outermost points.
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
from scan2sim.pipeline.geometry.sorting import stable_argsort
from scan2sim.pipeline.geometry.voxel_grid import voxel_groups

EMPTY_PROBES = ((1.9, 1.5, 1.2), (1.9, 0.0, 1.2), (1.9, -1.5, 1.2), (1.9, -3.0, 1.2),
          (0.0, 2.2, 1.2), (0.0, -2.2, 1.2), (0.0, -4.0, 1.2))  # fmt: skip
"""Probes around a side that are empty if the surface ends there (it neither continues nor turns), in voxels: offset
outwards, offset in front of the plane, radius."""
MIN_CORNER_COS = float(np.cos(np.radians(15.0)))
"""Cosine of the turn below which a vertex of a contour is no corner."""
PARALLEL_COS = float(np.cos(np.radians(10.0)))


@dataclass(frozen=True)
class BoundaryLimits:
    """Thresholds of the boundaries; lengths in voxels."""

    point_tolerance: float = 0.4  # minimum tolerance of single points, of which a thinned one is the mean
    cells_per_voxel: int = 2  # of the mask
    closing_radius: float = 2.5  # gaps up to twice this are closed, as `trim` keeps them closed
    contour_tolerance: float = 0.8  # distance of a side from the contour of the mask
    min_fitted_length: float = 3.0  # shorter sides are not fitted to points
    min_hole_area: float = 10.0  # square voxels
    bin_length: float = 1.0  # part of a side whose outermost point is used
    search_depth: float = 2.0  # inside a side (and one voxel outside) for its outermost points
    min_bin_points: int = 3
    max_slope: float = 0.2  # rotation of a side when it is fitted
    min_slope_bins: int = 6  # sides with fewer bins are not rotated
    max_fit_error: float = 0.4  # of four bins out of five
    min_side_fraction: float = 0.5  # part of a side that must have the same plane behind it
    min_open_length: float = 10.0  # of an open boundary: round or small surfaces have shorter sides
    other_class_distance: float = 1.9  # around an open boundary, without points of other classes
    min_step: float = 0.4  # distance of two parallel planes with a step between them (reveals, ledges, parapets)
    max_step: float = 4.0
    cut_distance: float = 3.5  # beyond a side, within which the surface is cut off; `trim` leaves 2.5
    rim_depth: float = 1.2  # of a step face without a plane behind it: roof rims, parapets, sills
    step_point_spacing: float = 0.8  # of points on a step face


LIMITS = BoundaryLimits()


Line = tuple[F64, F64, bool]
"""A point (2,) on the line, its unit direction (2,), and whether it was fitted to the outermost points."""


@dataclass(frozen=True)
class Sides:
    """Straight sides of the boundaries of planes.

    Attributes:
        plane: (S,) index of the plane.
        start, end: (S, 3) local metres, on the plane; the inside is to the left.
        outward: (S, 3) unit vectors in the plane.
        fitted: (S,) bool, True if fitted to the outermost points (not for short sides, or in gaps).
        hole: (S,) bool, True for sides of a hole.
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
        """Planes through the sides, perpendicular to the planes of the surfaces."""
        return Planes(self.outward, (self.outward * self.start).sum(axis=1))

    def take(self, index: npt.NDArray[np.integer] | Bools) -> Sides:
        """Selected sides."""
        return Sides(*(getattr(self, name)[index] for name in self.__dataclass_fields__))

    def along(self, step: float) -> tuple[F64, I32]:
        """Points (N, 3) about every `step` metres, and the index (N,) of their side."""
        length = np.linalg.norm(self.end - self.start, axis=1)
        count = np.maximum(1, np.ceil(length / step)).astype(int)
        of = np.repeat(np.arange(len(self)), count).astype(np.int32)
        share = (np.arange(len(of)) - np.repeat(np.cumsum(count) - count, count) + 0.5) / count[of]
        return self.start[of] + share[:, None] * (self.end - self.start)[of], of


def assign_points(xyz: F32, planes: Planes, thin: F32, which: I32, voxel: float, tolerance: float) -> I32:
    """Plane (N,) of each point of a cloud, -1 for none: that of its voxel, else the nearest of its neighbours' planes.

    Args:
        xyz: (N, 3) local metres.
        planes: planes of the thinned points.
        thin: (M, 3) at most one point per voxel.
        which: (M,) their planes.
        voxel: voxel size, metres.
        tolerance: largest distance of a thinned point from its plane, metres; at least `point_tolerance` is used.
    """
    tolerance = max(tolerance, LIMITS.point_tolerance * voxel)
    on = np.flatnonzero(which >= 0)
    if not len(on):
        return np.full(len(xyz), -1, np.int32)
    order, starts = voxel_groups(np.concatenate([thin, xyz]), voxel)
    first = np.minimum(order[starts], len(thin))  # a thinned point, if the voxel has one
    own = np.empty(len(order), np.int32)
    own[order] = np.repeat(np.append(which, np.int32(-1))[first], np.diff(np.append(starts, len(order))))
    own = own[len(thin) :]
    own[(own >= 0) & (np.abs(planes.signed_distance(xyz, own)) > tolerance)] = -1
    rest = np.flatnonzero(own < 0)
    _, at = cKDTree(thin[on]).query(xyz[rest], 4, distance_upper_bound=2 * voxel, workers=-1)
    best = np.full(len(rest), tolerance)
    for column in np.append(which[on], np.int32(-1))[at].T:
        given = np.flatnonzero(column >= 0)
        off = np.abs(planes.signed_distance(xyz[rest[given]], column[given]))
        better = off < best[given]
        own[rest[given[better]]], best[given[better]] = column[given[better]], off[better]
    return own


def sides(xyz: F32, own: I32, planes: Planes, voxel: float) -> Sides:
    """Sides of the boundaries of all planes.

    Args:
        xyz: (N, 3) local metres, the whole cloud.
        own: (N,) plane of each point, -1 for none.
        planes: planes of the points.
        voxel: voxel size, metres.
    """
    order, of_plane = stable_argsort(own.astype(np.int64) + 1)
    first = np.searchsorted(of_plane, np.arange(len(planes) + 1) + 1)
    rows: list[tuple[int, F64, F64, F64, bool, bool]] = []
    for p in range(len(planes)):
        points = xyz[order[first[p] : first[p + 1]]].astype(np.float64)
        if len(points) < LIMITS.min_bin_points:
            continue
        axes = _axes(planes.normal[p])
        flat = points @ axes.T
        for ring, hole in _rings(flat, voxel):
            lines = [_fit(flat, a, b, voxel) for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True)]
            ring, lines = _remove_chamfers(ring, lines, voxel)
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


def step_faces(
    found: Sides, planes: Planes, thin: F32, which: I32, voxel: float, tolerance: float
) -> tuple[Planes, F64, I32]:
    """Step faces between parallel planes, at the sides of the one in front: window reveals, ledges.

    Args:
        found: sides of the planes.
        planes: planes of the points.
        thin: (M, 3) thinned points.
        which: (M,) their planes, -1 for none.
        voxel: voxel size, metres.
        tolerance: largest distance of points from their plane, metres; a plane twice as far behind is another one.

    Returns:
        Planes of the faces, perpendicular to both; points (M, 3) on them; and the face (M,) of each point.
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
    for depth in np.arange(LIMITS.min_step, LIMITS.max_step, 0.8) * voxel:
        probe = places + 1.5 * voxel * found.outward[of] - depth * normal[of]
        _, at = tree.query(probe, distance_upper_bound=1.2 * voxel, workers=-1)
        back = np.append(plane, np.int32(-1))[at]
        ok = (back >= 0) & (back != found.plane[of]) & (behind < 0)
        ok &= (planes.normal[back] * normal[of]).sum(axis=1) > PARALLEL_COS
        down = planes.signed_distance(places, back)
        ok &= (down > max(LIMITS.min_step * voxel, 2 * tolerance)) & (down < LIMITS.max_step * voxel)
        behind[ok] = back[ok]
    rim = _rim_points(places, of, found, normal, thin[which < 0], voxel)
    normals: list[F64] = []
    offsets: list[float] = []
    points: list[F64] = []
    whose: list[I32] = []
    for side in range(len(found)):
        here = behind[of == side]
        back = int(np.bincount(here + 1, minlength=2)[1:].argmax())
        outward = found.outward[side]
        line = places[of == side]
        if (here == back).mean() >= LIMITS.min_side_fraction:
            depth = float((line @ planes.normal[back] - planes.offset[back]).mean())
        elif rim[of == side].mean() >= LIMITS.min_side_fraction:
            depth = LIMITS.rim_depth * voxel
        else:
            continue
        rungs = (
            (np.arange(max(1, round(depth / voxel / LIMITS.step_point_spacing))) + 0.5)
            * depth
            / max(1, round(depth / voxel / LIMITS.step_point_spacing))
        )
        length = np.linalg.norm(found.end[side] - found.start[side])
        share = np.linspace(0, 1, max(2, int(length / (LIMITS.step_point_spacing * voxel))))[:, None]
        dense = found.start[side] + share * (found.end[side] - found.start[side])
        face = (dense[None] - rungs[:, None, None] * normal[side]).reshape(-1, 3)
        points.append(face)
        whose.append(np.full(len(face), len(normals), np.int32))
        normals.append(outward)
        offsets.append(float(outward @ found.start[side]))
    if not normals:
        return none
    return Planes(np.array(normals), np.array(offsets)), np.concatenate(points), np.concatenate(whose)


def _rim_points(places: F64, of: I32, found: Sides, normal: F64, loose: F32, voxel: float) -> Bools:
    """(N,) bool, True where points without a plane lie straight behind a side: a face too narrow for a plane."""
    if not len(loose):
        return np.zeros(len(places), bool)
    _, at = cKDTree(loose).query(
        places - 0.8 * LIMITS.rim_depth * voxel * normal[of], distance_upper_bound=0.8 * LIMITS.rim_depth * voxel
    )
    near = np.flatnonzero(at < len(loose))
    apart = loose[at[near]] - places[near]
    out, down = (apart * found.outward[of[near]]).sum(axis=1), -(apart * normal[of[near]]).sum(axis=1)
    rim = np.zeros(len(places), bool)
    rim[near] = (np.abs(out) < 0.3 * voxel) & (down > 0.4 * voxel)
    return rim


def open_boundaries(
    found: Sides, planes: Planes, thin: F32, which: I32, others: F32, border: F32, voxel: float
) -> tuple[F64, I32]:
    """Points (N, 3) on sides with nothing beyond them, and the side (N,) of each.

    Args:
        found: sides of the planes.
        planes: planes of the points.
        thin: (M, 3) thinned points of the planes' class.
        which: (M,) their planes, -1 for none.
        others: (K, 3) thinned points of all other classes: a wall has no open boundary at the ground.
        border: (B, 3) vertices on the mesh's border: only there can a surface end.
        voxel: voxel size, metres.
    """
    places, of = found.along(voxel)
    long = np.linalg.norm(found.end - found.start, axis=1) >= LIMITS.min_open_length * voxel
    ends = (found.fitted & long)[of]
    places, of = places[ends], of[ends]
    if not len(places):
        return places, of
    empty = np.isfinite(cKDTree(border).query(places, distance_upper_bound=LIMITS.cut_distance * voxel, workers=-1)[0])
    tree = cKDTree(np.concatenate([thin, others]))
    for out, depth, radius in EMPTY_PROBES:
        probe = places + voxel * (out * found.outward[of] + depth * planes.normal[found.plane[of]])
        near, _ = tree.query(probe, distance_upper_bound=radius * voxel, workers=-1)
        empty &= ~np.isfinite(near)
    if len(others):
        near, _ = cKDTree(others).query(places, distance_upper_bound=LIMITS.other_class_distance * voxel, workers=-1)
        empty &= ~np.isfinite(near)
    on = np.flatnonzero(which >= 0)
    _, at = cKDTree(thin[on]).query(places, 12, distance_upper_bound=1.5 * voxel, workers=-1)
    plane = np.append(which[on], np.int32(-1))[at]
    mine = found.plane[of][:, None]
    turned = np.abs(np.einsum("nkj,nj->nk", planes.normal[plane], planes.normal[mine[:, 0]])) < PARALLEL_COS
    empty &= ~((plane >= 0) & (plane != mine) & turned).any(axis=1)
    return places[empty], of[empty]


def cut_at_boundaries(
    vertices: F64, own: I32, planes: Planes, found: Sides, places: F64, of: I32, points: F32, voxel: float
) -> I32:
    """Planes (V,) of a mesh's vertices; vertices beyond open boundaries get the plane `len(planes) + side`.

    Args:
        vertices: (V, 3) local metres.
        own: (V,) their planes, -1 for none.
        planes, found: planes and their sides.
        places, of: result of `open_boundaries`.
        points: (M, 3) thinned points of the class.
        voxel: voxel size, metres.
    """
    own = own.copy()
    if not len(places):
        return own
    _, at = cKDTree(places).query(vertices, distance_upper_bound=LIMITS.cut_distance * voxel, workers=-1)
    near = np.flatnonzero(at < len(places))
    side = of[at[near]]
    plane = found.plane[side]
    loose = (own[near] < 0) | (own[near] == plane)
    near, side, plane = near[loose], side[loose], plane[loose]
    out = ((vertices[near] - found.start[side]) * found.outward[side]).sum(axis=1)
    off = planes.signed_distance(vertices[near], plane)
    far, _ = cKDTree(points).query(vertices[near], distance_upper_bound=1.2 * voxel, workers=-1)
    inner = (out <= 0) & (own[near] < 0) & (np.abs(off) < voxel)
    own[near[inner]] = plane[inner]
    gone = (out > 0) | (~np.isfinite(far) & (np.abs(off) > voxel))
    own[near[gone]] = (len(planes) + side[gone]).astype(np.int32)
    return own


def _axes(normal: F64) -> F64:
    """Unit axes (2, 3) in a plane: horizontal and up, right-handed with its normal."""
    level = np.cross([0.0, 0.0, 1.0], normal)
    level = level / np.linalg.norm(level) if np.linalg.norm(level) > 0.1 else np.array([1.0, 0.0, 0.0])
    level -= normal * (normal @ level)
    level /= np.linalg.norm(level)
    return np.stack([level, np.cross(normal, level)])


def _rings(flat: F64, voxel: float) -> list[tuple[F64, bool]]:
    """Corners (K, 2) of rings around points (N, 2), inside to the left; and whether a ring is that of a hole."""
    cell = voxel / LIMITS.cells_per_voxel
    margin = int(np.ceil(LIMITS.closing_radius * LIMITS.cells_per_voxel)) + 2
    low = np.floor(flat.min(axis=0) / cell).astype(int) - margin
    at = np.floor(flat / cell).astype(int) - low
    mask = np.zeros((at[:, 1].max() + margin + 1, at[:, 0].max() + margin + 1), np.uint8)
    mask[at[:, 1], at[:, 0]] = 1
    radius = int(round(LIMITS.closing_radius * LIMITS.cells_per_voxel))
    square = cv2.getStructuringElement(cv2.MORPH_RECT, (2 * radius + 1, 2 * radius + 1))
    mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, square).astype(np.uint8)
    contours, tree = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    rings = []
    for contour, links in zip(contours, tree[0] if tree is not None else (), strict=True):
        hole = bool(links[3] >= 0)
        if (
            len(contour) < 6
            or cv2.contourArea(contour) < (LIMITS.min_hole_area if hole else 1.0) * LIMITS.cells_per_voxel**2
        ):
            continue
        ring = _remove_straight_corners(
            cv2.approxPolyDP(contour, LIMITS.contour_tolerance * LIMITS.cells_per_voxel, closed=True)[:, 0]
        )
        if len(ring) < 3:
            continue
        x, y = ring[:, 0].astype(float), ring[:, 1].astype(float)
        area = (x * np.roll(y, -1) - np.roll(x, -1) * y).sum()
        if (area > 0) == hole:
            ring = ring[::-1]
        rings.append(((ring + low + 0.5) * cell, hole))
    return rings


def _remove_straight_corners(ring: npt.NDArray[np.integer]) -> npt.NDArray[np.integer]:
    """Remove corners of a ring (K, 2) at which it is almost straight."""
    while len(ring) > 3:
        direction = (np.roll(ring, -1, axis=0) - ring).astype(float)
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        same = (direction * np.roll(direction, 1, axis=0)).sum(axis=1)
        if same.max() < MIN_CORNER_COS:
            break
        ring = np.delete(ring, int(same.argmax()), axis=0)
    return ring


def _fit(flat: F64, a: F64, b: F64, voxel: float) -> Line:
    """Line along the side from `a` to `b`, fitted to the outermost points if possible."""
    length = float(np.linalg.norm(b - a))
    along = (b - a) / max(length, 1e-9)
    if length < LIMITS.min_fitted_length * voxel:
        return (a + b) / 2, along, False
    out = np.array([along[1], -along[0]])
    count, far = _outermost(
        flat, a, along, length, max(3, int(length / (LIMITS.bin_length * voxel))), -LIMITS.search_depth * voxel, voxel
    )
    bins = len(count)
    good = count >= LIMITS.min_bin_points
    if good.sum() < max(3, bins // 2):
        return (a + b) / 2, along, False
    # n points spread over a bin leave a mean gap of 1 / n of its depth
    extent = far[good] + (far[good] + LIMITS.search_depth * voxel) / count[good]
    where = (np.flatnonzero(good) + 0.5) / bins * length
    slope = 0.0
    if len(where) >= LIMITS.min_slope_bins:
        i, j = np.triu_indices(len(where), 1)
        slope = float(np.median((extent[j] - extent[i]) / (where[j] - where[i])))
    if abs(slope) > LIMITS.max_slope:
        return (a + b) / 2, along, False
    level = float(np.median(extent - slope * where))
    turned = along + slope * out
    turned /= np.linalg.norm(turned)
    miss = np.quantile(np.abs(extent - slope * where - level), 0.8)
    return a + level * out, turned, bool(miss < LIMITS.max_fit_error * voxel)


@njit(cache=True)
def _outermost(flat: F64, start: F64, along: F64, length: float, bins: int, low: float, high: float) -> tuple[I64, F64]:
    """Number (B,) of points (N, 2) and largest distance (B,) to the right of a line, in each of its bins.

    Only points between `low` and `high` metres to its right are used.
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


def _remove_chamfers(ring: F64, lines: list[Line], voxel: float) -> tuple[F64, list[Line]]:
    """Remove short sides that the morphological closing has added across corners of a ring."""
    length = np.linalg.norm(np.roll(ring, -1, axis=0) - ring, axis=1)
    count, kept = len(ring), list(range(len(ring)))
    places = ring.copy()
    for k in range(count):
        before, after = lines[k - 1], lines[(k + 1) % count]
        if (
            lines[k][2]
            or not (before[2] and after[2])
            or length[k] > 2 * LIMITS.closing_radius * voxel
            or len(kept) <= 3
        ):
            continue
        crossing = _intersection(before, after)
        middle = (ring[k] + ring[(k + 1) % count]) / 2
        if crossing is not None and np.linalg.norm(crossing - middle) < LIMITS.closing_radius * voxel:
            kept.remove(k)
            places[(k + 1) % count] = crossing
    return places[kept], [lines[k] for k in kept]


def _intersection(before: Line, after: Line) -> F64 | None:
    """Intersection of two lines; None if they are almost parallel."""
    (p, d, _), (q, e, _) = before, after
    cross = d[0] * e[1] - d[1] * e[0]
    return p + ((q - p)[0] * e[1] - (q - p)[1] * e[0]) / cross * d if abs(cross) > 0.3 else None


def _corner(before: Line, after: Line, place: F64, voxel: float) -> F64:
    """Intersection of two sides near `place`; else the projection of `place` onto the one that was fitted."""
    (p, d, one), (q, e, two) = before, after
    crossing = _intersection(before, after)
    if crossing is not None and np.linalg.norm(crossing - place) < 3 * voxel:
        return crossing
    if one or not two:
        return p + ((place - p) @ d) * d
    return q + ((place - q) @ e) * e
