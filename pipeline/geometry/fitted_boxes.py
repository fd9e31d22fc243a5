"""Boxes around points: groups of points as few upright boxes, which are split where they enclose empty space.

What stands on the floor is solid down to it; what is above free space (table tops) is a slab, and its legs are boxes of
their own. Parts that were hidden, such as the inside and the back of a cupboard, are solid where no floor was seen.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from scan2sim.pipeline.core.types import F32, F64, I32, I64, Bools


@dataclass(frozen=True)
class BoxModel:
    """Limits; lengths in metres."""

    dense_voxel: float = 0.15
    dense_share: float = 0.25
    column: float = 0.1
    """Smallest side of a column in plan view; columns that touch are a group."""
    column_spacings: float = 1.6
    min_points: int = 12
    overhang: float = 0.45
    """Height above the floor below which nothing of a table top is."""
    overhang_share: float = 0.15
    floor_share: float = 0.3
    """Share of the usual density of floor points from which a column shows the floor; of an overhang's columns, those
    that do at least."""
    hidden_depth: float = 0.35
    """Distance from a group's columns up to which hidden ones belong to it."""
    ring: int = 4
    """Width in columns of the ring around a group in which the floor"""
    ring_share: float = 0.5
    """was seen in this share at least, so that where it wasn't, something hides it."""
    gain: tuple[float, float] = (0.015, 0.1)
    """Volume (m3) between columns and their box that another box must save, and that as share of the box's,"""
    fill: tuple[float, float] = (0.35, 0.65)
    """unless fewer of the columns of a small or a large box have points: a box may not close what is open."""
    large: float = 2.5
    """Plan of a large box, m2."""
    low: float = 0.1
    """Height up to which points on the floor are its noise."""
    max_boxes: int = 16
    boxes_per_m2: float = 4.0
    """Further boxes of a large group."""
    trim: float = 0.02
    """Share of points at each end of a box that are noise."""
    noise_widths: float = 1.2
    """Distance of these ends from the true face, in standard deviations of the noise."""
    heading_gain: float = 0.9
    """Share of the plan that a group's own heading must save, to replace the direction of the walls,"""
    heading_fill: float = 0.6
    """and share of that plan that must be full: several things beside each other have no heading."""
    top: float = 0.9
    """Share of a column's points below its top."""


MODEL = BoxModel()
CORNERS = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)])
FACES = np.array([
    [0, 2, 3], [0, 3, 1], [4, 5, 7], [4, 7, 6], [0, 1, 5], [0, 5, 4], [2, 6, 7], [2, 7, 3], [0, 4, 6], [0, 6, 2],
    [1, 3, 7], [1, 7, 5],
])  # fmt: skip


class Box(NamedTuple):
    """An upright box: heading of its x axis (radians), lowest and highest corner (3,) in its own axes."""

    heading: float
    low: F64
    high: F64


@dataclass(frozen=True)
class Surroundings:
    """What is known around the points.

    Attributes:
        floor: (M, 3) points of the floor; empty: not seen.
        bottom: height of the floor, metres; None: unknown.
        heading: usual direction of the x axis, radians: that of the walls.
        noise: standard deviation of the points, metres.
    """

    floor: F32 = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    bottom: float | None = None
    heading: float = 0.0
    noise: float = 0.0


def fit_boxes(
    xyz: F32, spacing: float, max_boxes: int = MODEL.max_boxes, around: Surroundings | None = None
) -> list[Box]:
    """Boxes of points (N, 3); groups of touching columns get at most `max_boxes`, and more if large."""
    around = around or Surroundings()
    if len(xyz) < MODEL.min_points:
        return []
    found: list[Box] = []
    for group in _groups(_dense(xyz, spacing), spacing, around):
        found += _boxes(group, max_boxes, around)
    return found


def mesh_of(boxes: list[Box]) -> tuple[F32, I32]:
    """Vertices (8 B, 3) and faces (12 B, 3) of boxes, counter-clockwise seen from outside."""
    vertices = [np.zeros((0, 3))]
    for box in boxes:
        own = box.low + CORNERS * (box.high - box.low)
        vertices.append(np.column_stack([own[:, :2] @ _turn(box.heading).T, own[:, 2]]))
    faces = (8 * np.arange(len(boxes))[:, None, None] + FACES).reshape(-1, 3)
    return np.concatenate(vertices).astype(np.float32), faces.astype(np.int32)


def _dense(xyz: F32, spacing: float) -> F32:
    """The points in voxels with a quarter of the usual number of points: scattered ones would join what is apart."""
    key = np.floor(xyz / max(MODEL.dense_voxel, 3 * spacing)).astype(np.int64)
    _, of_point, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    own = count[of_point.ravel()]
    return xyz[own >= MODEL.dense_share * float(np.median(own))]


class _Group(NamedTuple):
    """Points (G, 3) in touching columns.

    Attributes:
        points: metres.
        hidden: (I, J) whether a column without points belongs to it.
        corner: (2,) position of the corner of column (0, 0).
        stands: whether it stands on the floor.
        cell: side of a column, metres.
    """

    points: F64
    hidden: Bools
    corner: F64
    stands: bool
    cell: float

    def hides(self, xy: F64) -> Bools:
        """(N,) whether positions (N, 2) are in hidden columns."""
        at = np.floor((xy - self.corner) / self.cell).astype(np.int64)
        inside: Bools = np.asarray(((at >= 0) & (at < self.hidden.shape)).all(axis=1))
        at = np.where(inside[:, None], at, 0)
        return inside & self.hidden[at[:, 0], at[:, 1]]


def _groups(xyz: F32, spacing: float, around: Surroundings) -> Iterator[_Group]:
    """Groups of points in touching columns: those on the floor, and those above it."""
    from scipy import ndimage

    cell = max(MODEL.column, MODEL.column_spacings * spacing)
    low = xyz[:, :2].min(axis=0) - (MODEL.ring + 1) * cell
    shape = np.floor((xyz[:, :2].max(axis=0) - low) / cell).astype(np.int64) + MODEL.ring + 2

    def cells(points: F32) -> I64:
        index = np.floor((points[:, :2] - low) / cell).astype(np.int64)
        inside = ((index >= 0) & (index < shape)).all(axis=1)
        return np.where(inside, index[:, 0] * shape[1] + index[:, 1], shape.prod())

    def count(flat: I64) -> I64:
        return np.bincount(flat, minlength=shape.prod() + 1)[:-1].reshape(shape)

    flat = cells(xyz)
    total = count(flat)
    ground = count(cells(around.floor)) if len(around.floor) else np.zeros(shape, np.int64)
    usual = float(np.median(ground[ground > 0])) if ground.any() else np.inf
    shows_floor = ground >= max(MODEL.floor_share * usual, 1.0)
    hangs = np.zeros(shape, bool)
    if around.bottom is not None:
        lower = count(flat[xyz[:, 2] < around.bottom + MODEL.overhang])
        hangs = (total > 0) & (lower < MODEL.overhang_share * total)
        label, number = ndimage.label(hangs, np.ones((3, 3)))
        over_floor = ndimage.mean(shows_floor, label, np.arange(number + 1)) >= MODEL.floor_share
        over_floor[0] = False
        hangs = over_floor[label] if ground.any() else hangs
    for kind, stands in (((total > 0) & ~hangs, True), (hangs, False)):
        label, _ = ndimage.label(kind, np.ones((3, 3)))
        of_point = label.ravel()[flat]
        order = np.argsort(of_point, kind="stable")
        ends = np.searchsorted(of_point[order], np.arange(1, label.max() + 2))
        for k, window in enumerate(ndimage.find_objects(label), start=1):
            points = xyz[order[ends[k - 1] : ends[k]]].astype(np.float64)
            if len(points) < MODEL.min_points:
                continue
            own = label[window] == k
            hidden = np.zeros(own.shape, bool)
            if stands and _floor_is_seen(label == k, window, shows_floor):
                near = ndimage.distance_transform_edt(~own) * cell < MODEL.hidden_depth
                hidden = _hull(own) & near & ~shows_floor[window] & ((label[window] == 0) | own)
            corner = low + cell * np.array([one.start for one in window])
            yield _Group(points, hidden, corner, stands, cell)


def _floor_is_seen(own: Bools, window: tuple[slice, ...], shows_floor: Bools) -> bool:
    """Whether the floor around a group was seen, so that where it wasn't, something hid it."""
    from scipy import ndimage

    i, j = (slice(max(one.start - MODEL.ring, 0), one.stop + MODEL.ring) for one in window)
    inside = own[i, j]
    ring = ndimage.binary_dilation(inside, np.ones((3, 3)), MODEL.ring) & ~ndimage.binary_dilation(_hull(inside))
    return bool(ring.any() and shows_floor[i, j][ring].mean() > MODEL.ring_share)


def _hull(mask: Bools) -> Bools:
    """The convex hull of a mask's cells."""
    from scipy.spatial import ConvexHull, QhullError

    at = np.argwhere(mask)
    try:
        planes = ConvexHull(at).equations
    except (QhullError, ValueError):
        return mask
    every = np.argwhere(np.ones_like(mask))
    return np.asarray((every @ planes[:, :2].T + planes[:, 2] <= 1e-9).all(axis=1).reshape(mask.shape))


def _turn(heading: float) -> F64:
    c, s = np.cos(heading), np.sin(heading)
    return np.array([[c, -s], [s, c]])


def _heading(xy: F64, cell: float, main: float) -> float:
    """Heading of the smallest rectangle around points (N, 2); that of the walls, if it is hardly larger or not full."""
    some = xy[:: max(1, len(xy) // 2000)]

    def area(heading: float) -> float:
        low, high = np.quantile(some @ _turn(heading), (0.02, 0.98), axis=0)
        return float(np.prod(high - low + 0.02))

    best = min((float(h) for h in np.radians(np.arange(0, 90, 3.0))), key=area)
    full = len(np.unique(np.floor(xy / cell), axis=0)) * cell**2
    return best if area(best) < min(MODEL.heading_gain * area(main), full / MODEL.heading_fill) else main


@dataclass
class _Heights:
    """Heights (I, J) above the base of the columns of a group, 0: not part of it, and side of a column; metres."""

    height: F64
    cell: float

    def fit(self, window: Window) -> Fit | None:
        """The window without empty borders, the height of its box, and the volume between both per area of a column."""
        i0, i1, j0, j1 = window
        own = self.height[i0:i1, j0:j1]
        rows, cols = np.flatnonzero(own.any(axis=1)), np.flatnonzero(own.any(axis=0))
        if not len(rows):
            return None
        own = own[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1]
        top = float(np.quantile(own[own > 0], 0.7))
        smaller = i0 + int(rows[0]), i0 + int(rows[-1]) + 1, j0 + int(cols[0]), j0 + int(cols[-1]) + 1
        return smaller, top, float(np.abs(own - top).sum())

    def cut(self, part: Fit) -> tuple[float, list[Window]]:
        """What the best cut saves, 0 if that isn't worth it, and the two parts."""
        (i0, i1, j0, j1), top, cost = part
        best: tuple[float, list[Window]] = 0.0, []
        halves = [[(i0, i, j0, j1), (i, i1, j0, j1)] for i in range(i0 + 1, i1)]
        halves += [[(i0, i1, j0, j), (i0, i1, j, j1)] for j in range(j0 + 1, j1)]
        for pair in halves:
            found = [self.fit(one) for one in pair]
            saved = cost - sum(one[2] for one in found if one)
            if saved > best[0]:
                best = saved, [one[0] for one in found if one]
        own = self.height[i0:i1, j0:j1]
        least = max(MODEL.gain[0] / self.cell**2, MODEL.gain[1] * top * own.size)
        full = MODEL.fill[int(own.size * self.cell**2 > MODEL.large)]
        return best if best[0] >= least or (own > 0).mean() < full else (0.0, [])


Window = tuple[int, int, int, int]
Fit = tuple[Window, float, float]


def _boxes(group: _Group, max_boxes: int, around: Surroundings) -> list[Box]:
    """Boxes of one group: columns of similar heights, by cuts that save most volume."""
    from scipy import ndimage

    cell = group.cell
    heading = _heading(group.points[:, :2], cell, around.heading % (np.pi / 2))
    turn = _turn(heading)
    xy, z = group.points[:, :2] @ turn, group.points[:, 2]
    base = around.bottom if group.stands and around.bottom is not None else float(np.quantile(z, MODEL.trim))
    corner = xy.min(axis=0)
    at = np.floor((xy - corner) / cell).astype(np.int64)
    shape = tuple(at.max(axis=0) + 1)
    flat = at[:, 0] * shape[1] + at[:, 1]
    count = np.bincount(flat, minlength=shape[0] * shape[1])
    order = np.lexsort([z, flat])
    first = np.cumsum(count) - count
    last = first + np.maximum(np.ceil(MODEL.top * count).astype(np.int64) - 1, 0)
    top = np.where(count > 0, z[order][np.minimum(last, len(z) - 1)] - base, 0.0)
    enough = count >= MODEL.dense_share * np.median(count[count > 0])
    enough &= (top > MODEL.low) | (base != around.bottom)
    height = np.where(enough, np.maximum(top, 0.02), 0.0).reshape(shape)
    if group.hidden.any():
        centre = corner + cell * (np.argwhere(height == 0) + 0.5)
        filled = np.zeros(shape, bool)
        filled[height == 0] = group.hides(centre @ turn.T)
        near = ndimage.distance_transform_edt(height == 0, return_distances=False, return_indices=True)
        height = np.where(filled, height[tuple(near)], height)
    full = enough.reshape(shape), height > 0
    heights = _Heights(height, cell)
    start = heights.fit((0, shape[0], 0, shape[1]))
    parts = [start] if start else []
    most = max_boxes + round(MODEL.boxes_per_m2 * float((height > 0).sum()) * cell**2)
    while len(parts) < most:
        cuts = [heights.cut(part) for part in parts]
        best = max(range(len(parts)), key=lambda k: cuts[k][0], default=None)
        if best is None or cuts[best][0] <= 0:
            break
        parts[best : best + 1] = [one for one in map(heights.fit, cuts[best][1]) if one]
    return [_box(part[0], part[1], heading, corner, base, at, xy, z, group, around.noise, full) for part in parts]


def _box(
    window: Window, top: float, heading: float, corner: F64, base: float, at: I64, xy: F64, z: F64, group: _Group,
    noise: float, full: tuple[Bools, Bools],
) -> Box:  # fmt: skip
    """The box of a window of columns, its outer sides moved to their faces.

    `full`: (I, J) whether columns have points, and whether they belong to the group.
    """
    i0, i1, j0, j1 = window
    low, high = corner + group.cell * np.array([i0, j0]), corner + group.cell * np.array([i1, j1])
    inside = (at[:, 0] >= i0) & (at[:, 0] < i1) & (at[:, 1] >= j0) & (at[:, 1] < j1)
    seen, own = (np.pad(mask, 1) for mask in full)
    shrink = MODEL.noise_widths * noise
    for axis in range(2 if inside.sum() >= MODEL.min_points else 0):
        span = high[axis] - low[axis]
        first, last = (i0, i1) if axis == 0 else (j0, j1)
        across = slice(j0 + 1, j1 + 1) if axis == 0 else slice(i0 + 1, i1 + 1)
        ends = np.quantile(xy[inside, axis], (MODEL.trim, 1 - MODEL.trim))
        for side, row, beyond in ((0, first + 1, first), (1, last, last + 1)):
            border, part, next_part = (
                mask[k, across] if axis == 0 else mask[across, k]
                for mask, k in ((seen, row), (own, row), (own, beyond))
            )
            if border.sum() < 0.5 * part.sum() or next_part.mean() >= 0.5:
                continue
            if side == 0:
                low[axis] = min(max(low[axis], ends[0] + shrink), low[axis] + 0.4 * span)
            else:
                high[axis] = max(min(high[axis], ends[1] - shrink), high[axis] - 0.4 * span)
        thin = max(0.03 - (high[axis] - low[axis]), 0.0) / 2
        low[axis], high[axis] = low[axis] - thin, high[axis] + thin
    upper = base + top
    lower = base if group.stands or not inside.any() else min(float(np.quantile(z[inside], 0.05)), upper - 0.03)
    return Box(heading, np.array([*low, lower]), np.array([*high, upper]))
