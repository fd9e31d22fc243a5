"""Vehicles and people as whole things: clusters above the ground, each weighed by its size, its votes and its place.

A vehicle is a box on the ground. Two kinds of clusters are offered: points that photos take for vehicles, and points
at the height of doors, whatever their class; the first parts a car from the hedge that it touches, the second finds a
car of which photos classify the half. A box is fitted to each (Zhang et al., "Efficient L-shape fitting for vehicle
detection using laser scanners", IV 2017: the rectangle that points lie nearest to the sides of), and what speaks for a
vehicle is summed as logarithms of likelihood ratios: whether its size is one of `KINDS`, what photos say of all points
in the box, and whether it stands free. What is accepted is taken whole: all that is above the ground in its box.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.spatial import cKDTree

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.types import F32, F64, I64, U8, Bools

Span = tuple[float, float]


class Kind(NamedTuple):
    """A kind of vehicle: metres from and to, as registered vehicles are (mirrors apart).

    Its `odds` are the logarithm of how much likelier vehicles are of this size than other things: the wider its spans,
    the less its size says.
    """

    name: str
    length: Span
    width: Span
    height: Span
    odds: float


KINDS = (
    Kind("car", (2.5, 5.6), (1.4, 2.15), (1.2, 2.0), 2.5),
    Kind("van", (4.0, 7.5), (1.6, 2.3), (1.7, 3.1), 2.0),
    Kind("truck", (5.0, 19.0), (2.0, 2.75), (2.2, 4.3), 1.0),
)
CELL = 0.2
"""Metres of the plan's cells by which points are one cluster: things half a metre apart are two."""
BAND = (0.3, 2.6)
"""Metres above ground in which points that are classified as vehicles make clusters: wheels and crowns touch others."""
DOORS = (0.3, 1.2)
"""The same for clusters of any class."""
TALLEST = 4.3
FEET = 0.1
"""Metres above the ground from which on a point in a box is the vehicle's: below is the road's noise."""
GAP = 0.5
"""Metres without a point above a vehicle's roof: what is above that is a crown or a sign."""
SKIN, MIRROR = 0.15, 0.35
"""Metres around a box that are the vehicle's: any point, and one that photos take for a vehicle's."""
LEAST = 12
"""Voxels of a cluster: fewer have no shape."""
ONE_SIDE = 1.3
"""Metres: a vehicle that seems to be narrower was seen from one side, and goes on behind it."""
WITNESSES = 2.0
"""Points of one thing count as so many independent observations: photos confuse a thing as a whole."""
FREE = (0.15, 0.6)
"""Share of cells at a box's ends that hold something: as few as where it stands free, as many as within a wall."""
PRIOR = -3.0
"""Logarithm of the odds that a cluster is a vehicle before anything is known of it: bushes and bins are more."""
THIN, LONG = 0.5, 2.0
"""Metres: what is narrower and longer is a wall or a fence, no vehicle."""
WIDEST = 6.0
"""Metres: what is wider is no vehicle either, nor a row of them side by side."""
FIXED = (CODE["building"], CODE["pole"], CODE["road_sign"])
"""Classes of which nothing goes because something drove past near by."""
TOUCHING = 0.02
"""Share of a cluster's points near which others moved, from which on it touches them."""
LANE = 3.0
"""Metres."""
CARVED = 0.3
"""Share of a thing's points near which others moved, from which on all of it moved."""
MOSTLY = 0.5
"""Share of a standing person's points that are classified as one's, at least: of bins and posts it is a part."""


@dataclass(frozen=True)
class Thing:
    """A vehicle or a person.

    Attributes:
        kind: of `KINDS`, "part" (of a vehicle, of which too little was scanned to tell), "row" (vehicles that touch),
            or "person".
        centre: (3,) middle of its box on the ground, local metres.
        heading: radians of its length from x, anticlockwise; which end is the front isn't known.
        length, width, height: metres.
        odds: logarithm of the odds that it is one.
        moved: it moved while it was scanned.
        index: of its points.
    """

    kind: str
    centre: F64
    heading: float
    length: float
    width: float
    height: float
    odds: float
    moved: bool
    index: I64

    @property
    def box(self) -> Rectangle:
        """Its box in plan."""
        return Rectangle(self.centre[0], self.centre[1], self.heading, self.length, self.width)

    @property
    def corners(self) -> F64:
        """(4, 2) of its box, anticlockwise, local metres."""
        along = np.array([np.cos(self.heading), np.sin(self.heading)])
        across = np.array([-along[1], along[0]])
        half = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) / 2
        return self.centre[:2] + half[:, :1] * self.length * along + half[:, 1:] * self.width * across


class Rectangle(NamedTuple):
    """In plan, metres, local; `length` is the longer side."""

    x: float
    y: float
    heading: float
    length: float
    width: float

    def inside(self, xy: npt.NDArray[np.floating], margin: float) -> Bools:
        """(N,) which places (N, 2) are within it, `margin` metres larger on all sides."""
        u, v = self.own(xy)
        return (np.abs(u) <= self.length / 2 + margin) & (np.abs(v) <= self.width / 2 + margin)

    def own(self, xy: npt.NDArray[np.floating]) -> tuple[F64, F64]:
        """Places along its length and across, from its middle."""
        c, s = np.cos(self.heading), np.sin(self.heading)
        dx, dy = xy[:, 0].astype(np.float64) - self.x, xy[:, 1].astype(np.float64) - self.y
        return c * dx + s * dy, c * dy - s * dx


@dataclass(frozen=True)
class Scan:
    """What is known of (N,) points, thinned to about one a voxel.

    Attributes:
        xyz: local metres.
        height: metres above ground.
        ground: which are of the ground.
        classification: LAS codes.
        odds: logarithm of the odds that photos, or shape alone, give to vehicle.
        weight: what that counts.
        moved: near points that moved.
        brief: scanned, with all around, within a second: what stands is seen for longer.
        path: (T, 3) of the scanner.
    """

    xyz: F32
    height: F32
    ground: Bools
    classification: U8
    odds: F32
    weight: F32
    moved: Bools
    brief: Bools
    path: F64


def vehicles(scan: Scan) -> list[Thing]:
    """All vehicles, the surest first; no point is of two."""
    tree = cKDTree(scan.xyz[:, :2])
    above = ~scan.ground & (scan.height > FEET) & (scan.height < TALLEST)
    classified = above & (scan.classification == CODE["vehicle"])
    offered = [
        thing
        for member in (classified & _between(scan.height, BAND), above & _between(scan.height, DOORS))
        for cluster in clusters(scan.xyz, member)
        if (thing := _vehicle(scan, tree, above, cluster)) is not None
    ]
    taken = np.zeros(len(scan.xyz), bool)
    found = []
    for thing in sorted(offered, key=lambda t: -t.odds * np.sqrt(len(t.index))):
        fresh = thing.index[~taken[thing.index]]
        if len(fresh) < max(LEAST, 0.5 * len(thing.index)):
            continue  # of one that is found already
        taken[thing.index] = True
        found.append(Thing(**{**thing.__dict__, "index": fresh}))
    return found


def no_vehicles(scan: Scan, found: Sequence[Thing]) -> I64:
    """Indices of points that are classified as vehicles, but lie on the ground or in clusters of no vehicle's shape.

    What is classified so below the vehicles that were `found` is theirs: wheels and sills.
    """
    classified = scan.classification == CODE["vehicle"]
    if found:
        tree = cKDTree(scan.xyz[:, :2])
        for thing in found:
            near = np.array(tree.query_ball_point(thing.centre[:2], thing.length / 2 + 1.5), np.int64)
            classified[near[thing.box.inside(scan.xyz[near, :2], SKIN)]] = False
    wrong = classified & (scan.ground | (scan.height < FEET))
    for cluster in clusters(scan.xyz, classified & ~wrong):
        box = rectangle(scan.xyz[cluster, :2])
        if (box.width < THIN and box.length > LONG) or box.width > WIDEST:
            wrong[cluster] = True
    return np.flatnonzero(wrong)


def remains(scan: Scan) -> I64:
    """Indices of points of what moved, and wasn't carved: where a trail begins and ends, nothing sees through it.

    These are clusters above the ground, no wider than a lane, that touch what was carved, and were there for a moment
    only. A garden that is seen through a gate is there for a moment, too, but wider.
    """
    above = ~scan.ground & _between(scan.height, (FEET, TALLEST)) & ~np.isin(scan.classification, FIXED)
    near = [
        c
        for c in clusters(scan.xyz, above & scan.brief)
        if scan.moved[c].mean() > TOUCHING and rectangle(scan.xyz[c, :2]).width < LANE
    ]
    near += [c for c in clusters(scan.xyz, above) if scan.moved[c].mean() > 0.5]
    return np.unique(np.concatenate([*near, np.zeros(0, np.int64)]))


def people(scan: Scan) -> list[Thing]:
    """Clusters of a person's size that are classified as persons, whole."""
    return [thing for thing in _of_a_persons_size(scan) if _is_person(scan, thing)]


def no_people(scan: Scan) -> I64:
    """Indices of points that are classified as persons, in things of their size that most votes take for another."""
    classified = np.flatnonzero(scan.classification == CODE["person"])
    wrong = np.zeros(len(classified), bool)
    for thing in _of_a_persons_size(scan):
        if not _is_person(scan, thing):
            wrong |= thing.box.inside(scan.xyz[classified, :2], SKIN) & (scan.height[classified] < thing.height + 0.1)
    return classified[wrong]


def _is_person(scan: Scan, thing: Thing) -> bool:
    return thing.moved or float((scan.classification[thing.index] == CODE["person"]).mean()) > MOSTLY


def _of_a_persons_size(scan: Scan) -> list[Thing]:
    """All of that size of which some points are classified as a person's."""
    tree = cKDTree(scan.xyz[:, :2])
    found = []
    for cluster in clusters(scan.xyz, ~scan.ground & (scan.classification == CODE["person"]) & (scan.height < 2.3)):
        box = rectangle(scan.xyz[cluster, :2])
        top = float(scan.height[cluster].max())
        if not (box.length < 1.5 and 0.9 < top < 2.2):
            continue
        near = np.array(tree.query_ball_point((box.x, box.y), box.length / 2 + 0.3), np.int64)
        own = near[box.inside(scan.xyz[near, :2], SKIN) & (scan.height[near] > FEET) & (scan.height[near] < top + 0.1)]
        centre = np.array([box.x, box.y, _floor(scan, own)])
        moved = float(scan.moved[own].mean()) > CARVED
        found.append(Thing("person", centre, box.heading, box.length, box.width, top, 1.0, moved, own))
    return found


def _vehicle(scan: Scan, tree: cKDTree, above: Bools, cluster: I64) -> Thing | None:
    """The vehicle that a cluster is of, if it is of one."""
    box = rectangle(scan.xyz[cluster, :2])
    if not (1.0 < box.length < 40 and 0.4 < box.width < 4.5):
        return None
    near = np.array(tree.query_ball_point((box.x, box.y), np.hypot(box.length, box.width) / 2 + 3), np.int64)
    near = near[above[near]]
    within = near[box.inside(scan.xyz[near, :2], 0.0)]
    top = roof(scan.xyz[within, :2], scan.height[within])
    sized = _kind(box, top)
    if sized is None:
        return None
    kind, odds = sized
    if kind != "part":
        box = _whole(_stretched(box, scan, near, top), scan.path)
    inside = near[box.inside(scan.xyz[near, :2], SKIN) & (scan.height[near] < top + SKIN)]
    body = inside[scan.height[inside] > BAND[0]]
    if len(body) < LEAST:
        return None
    word = float((scan.odds[body] * scan.weight[body]).sum() / scan.weight[body].sum())
    odds += PRIOR + WITNESSES * word + _freedom(scan, near, box, top)
    if odds <= 0:
        return None
    classified = near[(scan.classification[near] == CODE["vehicle"]) & box.inside(scan.xyz[near, :2], MIRROR)]
    own = np.union1d(inside, classified[scan.height[classified] < top + GAP])
    moved = float(scan.moved[own].mean()) > CARVED
    centre = np.array([box.x, box.y, _floor(scan, own)])
    return Thing(kind, centre, box.heading, box.length, box.width, top, odds, moved, own)


def _kind(box: Rectangle, top: float) -> tuple[str, float] | None:
    """Which kind has this size, and the logarithm of how much likelier vehicles have it than other things."""
    for kind in KINDS:
        if _within(top, kind.height) and _within(box.length, kind.length):
            if _within(box.width, kind.width, 0.15):
                return kind.name, kind.odds
            if box.width < kind.width[0]:
                return kind.name, kind.odds - 1.7  # seen from one side
    if _within(top, (1.1, 2.0)) and box.length <= 5.6 and box.width <= 2.3:
        return "part", 0.0
    rows = (box.length > 5.6 and 1.4 < box.width < 2.6) or (box.length > 3.5 and 2.3 < box.width <= 5.6)
    return ("row", 0.0) if rows and _within(top, (1.2, 2.0)) and box.length < 30 else None


def _within(value: float, span: Span, slack: float = 0.1) -> bool:
    return span[0] - slack <= value <= span[1] + slack


def _stretched(box: Rectangle, scan: Scan, near: I64, top: float) -> Rectangle:
    """A box with the ends that photos took for something else: what goes on at its height up to free space.

    What goes on for longer than a vehicle is, or rises above its roof, is no part of it.
    """
    longest = max((k.length[1] for k in KINDS if _within(top, k.height) and _within(box.width, k.width)), default=0.0)
    u, v = box.own(scan.xyz[near])
    beyond = (np.abs(v) < box.width / 2) & (scan.height[near] > DOORS[0])
    ends = []
    for end in (-1, 1):
        out = end * u[beyond] - box.length / 2
        step = np.floor(out / CELL).astype(np.int64)
        count = np.bincount(step[step >= 0], minlength=1)
        tall = np.bincount(step[step >= 0], scan.height[near][beyond][step >= 0] > top + GAP, minlength=1)
        free = np.flatnonzero((count < 3) | (tall > 0))
        on = (step >= 0) & (step < (free[0] if len(free) else len(count)))
        ends.append(float(np.percentile(out[on], 95)) if on.any() else 0.0)
    if box.length + sum(ends) > longest + SKIN:
        return box
    shift = (ends[1] - ends[0]) / 2
    x, y = box.x + shift * np.cos(box.heading), box.y + shift * np.sin(box.heading)
    return box._replace(x=float(x), y=float(y), length=box.length + sum(ends))


def _whole(box: Rectangle, path: F64) -> Rectangle:
    """A box that was seen from one side, as wide as a vehicle is, away from the scanner."""
    if box.width >= ONE_SIDE:
        return box
    nearest = path[np.argmin(np.hypot(path[:, 0] - box.x, path[:, 1] - box.y)), :2]
    across = np.array([-np.sin(box.heading), np.cos(box.heading)])
    away = np.sign(across @ (np.array([box.x, box.y]) - nearest)) or 1.0
    shift = across * away * (1.6 - box.width) / 2
    return Rectangle(box.x + shift[0], box.y + shift[1], box.heading, box.length, 1.6)


def _freedom(scan: Scan, near: I64, box: Rectangle, top: float) -> float:
    """Logarithm of how much likelier its ends are so free for a vehicle than for a part of something larger.

    Its ends alone: cars park along walls and hedges.
    """
    beside = near[_between(scan.height[near], (DOORS[0], min(top, 1.5)))]
    u, v = box.own(scan.xyz[beside, :2])
    out = np.abs(u) - box.length / 2
    ends = beside[(out > SKIN) & (out < SKIN + 2 * CELL) & (np.abs(v) < box.width / 2)]
    cells = np.unique(np.floor(scan.xyz[ends, :2] / CELL), axis=0)
    share = len(cells) * CELL**2 / (2 * box.width * 2 * CELL)
    return float(np.interp(share, FREE, (1.0, -2.0)))


def roof(xy: F32, height: F32) -> float:
    """Metres from the ground to the top of what is connected upwards from the height of doors.

    Of cells of the plan it is the height that one in ten is above: a lamp post beside a hedge makes no van of it.
    """
    ordered = np.sort(height[height > DOORS[0]])
    if not len(ordered):
        return 0.0
    gaps = np.flatnonzero(np.diff(ordered) > GAP)
    lid = ordered[gaps[0]] if len(gaps) else ordered[-1]
    chosen = (height > DOORS[0]) & (height <= lid)
    _, cell = np.unique(np.floor(xy[chosen] / CELL), axis=0, return_inverse=True)
    tops = np.zeros(cell.max() + 1, np.float32)
    np.maximum.at(tops, cell.ravel(), height[chosen])
    return float(np.percentile(tops, 90))


def _floor(scan: Scan, index: I64) -> float:
    """Height of the ground below points, local metres."""
    return float(np.median(scan.xyz[index, 2] - scan.height[index])) if len(index) else 0.0


def clusters(xyz: F32, member: Bools) -> Iterator[I64]:
    """Indices of members that are connected in plan, of `LEAST` or more."""
    index = np.flatnonzero(member)
    if not len(index):
        return
    cell = np.floor((xyz[index, :2] - xyz[index, :2].min(axis=0)) / CELL).astype(np.int64)
    plan = np.zeros(cell.max(axis=0) + 1, bool)
    plan[tuple(cell.T)] = True
    part = ndimage.label(plan, np.ones((3, 3)))[0][tuple(cell.T)]
    order = np.argsort(part, kind="stable")
    for of in np.split(index[order], np.flatnonzero(np.diff(part[order])) + 1):
        if len(of) >= LEAST:
            yield of


def rectangle(xy: F32) -> Rectangle:
    """The rectangle whose sides (N, 2) places lie nearest to; one in a hundred at each end may stray."""
    some = xy[:: max(1, len(xy) // 400)].astype(np.float64)
    turns = np.radians(np.arange(0.0, 90.0, 2.0))[:, None]
    c, s = np.cos(turns), np.sin(turns)
    u, v = c * some[:, 0] + s * some[:, 1], c * some[:, 1] - s * some[:, 0]
    (u0, u1), (v0, v1) = (np.percentile(w, (1, 99), axis=1)[..., None] for w in (u, v))
    gap = np.minimum(np.minimum(np.abs(u - u0), np.abs(u1 - u)), np.minimum(np.abs(v - v0), np.abs(v1 - v)))
    best = int((1 / np.maximum(gap, 0.05)).mean(axis=1).argmax())
    turn = float(turns[best, 0])
    (a, b), (p, q) = (float(u0[best, 0]), float(u1[best, 0])), (float(v0[best, 0]), float(v1[best, 0]))
    middle = ((a + b) / 2, (p + q) / 2)
    x = float(np.cos(turn) * middle[0] - np.sin(turn) * middle[1])
    y = float(np.sin(turn) * middle[0] + np.cos(turn) * middle[1])
    if b - a >= q - p:
        return Rectangle(x, y, turn, b - a, q - p)
    return Rectangle(x, y, turn + np.pi / 2, q - p, b - a)


def _between(values: F32, span: Span) -> Bools:
    return np.asarray((values > span[0]) & (values < span[1]))
