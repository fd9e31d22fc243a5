"""Detection of vehicles and people as instances: clusters above ground, rated by size, class votes and surroundings.

A vehicle is a box on the ground. There are two kinds of candidate clusters: points classified as vehicles, and points
of any class at the height of doors. The first kind separates a car from a hedge that it touches, the second finds a car
of which only a part was classified correctly. A box is fitted to each cluster by L-shape fitting (Zhang et al.,
"Efficient L-shape fitting for vehicle detection using laser scanners", IV 2017: the rectangle whose sides the points
are closest to). The log-likelihood ratios for a vehicle are summed: whether the size is one of `KINDS`, the class votes
of all points in the box, and free space at its ends. All points above the ground in an accepted box belong to it.
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
    """A kind of vehicle: ranges of length, width (without mirrors) and height in metres, as of registered vehicles.

    `odds` is the log-likelihood ratio of vehicles to other objects of this size: smaller for wider ranges.
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
CLUSTER_CELL_M = 0.2
"""Cell size of the plan grid on which clusters are connected: objects half a metre apart are separate."""
VEHICLE_BAND_M = (0.3, 2.6)
"""Heights of points classified as vehicles that form clusters: wheels and tree crowns touch other objects."""
DOOR_BAND_M = (0.3, 1.2)
"""Heights of points of any class that form clusters."""
MAX_HEIGHT_M = 4.3
MIN_HEIGHT_M = 0.1
"""Height above ground from which a point in a box belongs to the vehicle: below is the noise of the road."""
ROOF_GAP_M = 0.5
"""Free height above a vehicle's roof: points above the gap belong to a tree crown or a sign."""
BOX_MARGIN_M, MIRROR_MARGIN_M = 0.15, 0.35
"""Margins of a box within which points belong to the vehicle: of any class, and classified as vehicle."""
MIN_VOXELS = 12
"""Voxels of the smallest cluster."""
MIN_FULL_WIDTH_M = 1.3
"""A vehicle with a narrower box was seen from one side only; its box is extended away from the scanner."""
INDEPENDENT_VOTES = 2.0
"""Number of independent observations that the points of an object count as: networks confuse objects as a whole."""
END_OCCUPANCY = (0.15, 0.6)
"""Share of occupied cells at the ends of a box: of a free-standing vehicle, and of a piece of a wall."""
PRIOR_LOG_ODDS = -3.0
"""Prior log odds that a cluster is a vehicle: bushes and bins are more frequent."""
FENCE_MAX_WIDTH_M = 0.4
"""Narrower clusters are wires of fences, and edges of what hides them."""
PASSING_SWEEPS_MAX = 2.5
"""Mean number of sweeps that see a place of something that drives by; what others hide is seen as often, or longer."""
ROAD_MARGIN_M, ROAD_SHARE = 0.5, 0.9
"""Margin of the ground around a cluster, and the share of it that is road from which the cluster stands on the road."""
STATIC_CLASSES = (CODE["building"], CODE["pole"], CODE["road_sign"])
"""Classes that are never removed because something passed nearby."""
TOUCHING_MOVED_SHARE = 0.02
"""Share of a cluster's points near moving points from which the cluster touches them."""
LANE_WIDTH_M = 3.0
MOVED_SHARE = 0.3
"""Share of an instance's points near moving points from which the whole instance moved."""
PERSON_SHARE = 0.5
"""Smallest share of a standing person's points classified as person: only parts of bins and posts are."""


@dataclass(frozen=True)
class Instance:
    """A vehicle or a person.

    Attributes:
        kind: name from `KINDS`, "part" (of a vehicle that was scanned too little), "row" (vehicles that touch each
            other), or "person".
        centre: (3,) centre of its box on the ground, local metres.
        heading: direction of its length in radians from x, counter-clockwise; front and back are not distinguished.
        length, width, height: size in metres.
        odds: log odds of the detection.
        moved: whether it moved while it was scanned.
        index: indices of its points.
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
        """Box in plan."""
        return Rectangle(self.centre[0], self.centre[1], self.heading, self.length, self.width)

    @property
    def corners(self) -> F64:
        """(4, 2) corners of the box, counter-clockwise, local metres."""
        return self.box.corners


class Rectangle(NamedTuple):
    """Rectangle in plan, local metres; `length` is the longer side."""

    x: float
    y: float
    heading: float
    length: float
    width: float

    @property
    def corners(self) -> F64:
        """(4, 2) corners, counter-clockwise, local metres."""
        along = np.array([np.cos(self.heading), np.sin(self.heading)])
        across = np.array([-along[1], along[0]])
        half = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) / 2
        return np.array([self.x, self.y]) + half[:, :1] * self.length * along + half[:, 1:] * self.width * across

    def inside(self, xy: npt.NDArray[np.floating], margin: float) -> Bools:
        """(N,) which points (N, 2) are within the rectangle, extended by `margin` metres on all sides."""
        u, v = self.to_local(xy)
        return (np.abs(u) <= self.length / 2 + margin) & (np.abs(v) <= self.width / 2 + margin)

    def to_local(self, xy: npt.NDArray[np.floating]) -> tuple[F64, F64]:
        """Coordinates of points along the length and across, from the centre."""
        c, s = np.cos(self.heading), np.sin(self.heading)
        dx, dy = xy[:, 0].astype(np.float64) - self.x, xy[:, 1].astype(np.float64) - self.y
        return c * dx + s * dy, c * dy - s * dx


@dataclass(frozen=True)
class Scan:
    """A scan with about one point per voxel: (N,) arrays, and the path.

    Attributes:
        xyz: (N, 3) local metres.
        height: metres above ground.
        ground: whether the point is ground.
        classification: LAS codes.
        odds: log odds of the class vehicle, by photos or by shape alone.
        weight: weight of the odds.
        moved: whether the point is near points that moved.
        brief: whether the point and its neighbours were scanned within a second; static objects are seen for longer.
        seen, passed: numbers of sweeps that saw the point, and whose rays passed it (`pipeline.lidar.sightings`).
        path: (T, 3) path of the scanner.
    """

    xyz: F32
    height: F32
    ground: Bools
    classification: U8
    odds: F32
    weight: F32
    moved: Bools
    brief: Bools
    seen: I64
    passed: I64
    path: F64


def vehicles(scan: Scan) -> list[Instance]:
    """Vehicles, the most certain first; each point belongs to at most one (non-maximum suppression)."""
    tree = cKDTree(scan.xyz[:, :2])
    above = ~scan.ground & (scan.height > MIN_HEIGHT_M) & (scan.height < MAX_HEIGHT_M)
    classified = above & (scan.classification == CODE["vehicle"])
    candidates = [
        candidate
        for member in (classified & _between(scan.height, VEHICLE_BAND_M), above & _between(scan.height, DOOR_BAND_M))
        for cluster in clusters(scan.xyz, member)
        if (candidate := _vehicle(scan, tree, above, cluster)) is not None
    ]
    assigned = np.zeros(len(scan.xyz), bool)
    found = []
    for candidate in sorted(candidates, key=lambda t: -t.odds * np.sqrt(len(t.index))):
        unassigned = candidate.index[~assigned[candidate.index]]
        if len(unassigned) < max(MIN_VOXELS, 0.5 * len(candidate.index)):
            continue  # overlaps a vehicle that was accepted before
        assigned[candidate.index] = True
        found.append(Instance(**{**candidate.__dict__, "index": unassigned}))
    return found


def loose_vehicle_points(scan: Scan, found: Sequence[Instance]) -> tuple[I64, list[I64]]:
    """Points classified as vehicle that no instance contains.

    Such points below the vehicles that were `found` are theirs: they are wheels and sills.

    Returns:
        Indices of points that are no vehicle, and clusters (indices) that are: they came or left while the scanner
        passed. What stays, but doesn't have the shape of a vehicle, is none.
    """
    classified = scan.classification == CODE["vehicle"]
    if found:
        tree = cKDTree(scan.xyz[:, :2])
        for instance in found:
            near = np.array(tree.query_ball_point(instance.centre[:2], instance.length / 2 + 1.5), np.int64)
            below = scan.height[near] < instance.height + BOX_MARGIN_M
            classified[near[below & instance.box.inside(scan.xyz[near, :2], BOX_MARGIN_M)]] = False
            classified[instance.index] = False
    above = classified & ~scan.ground & _between(scan.height, (MIN_HEIGHT_M, MAX_HEIGHT_M))
    still = classified & ~(above & (scan.moved | scan.brief | (scan.passed > scan.seen)))
    passing = []
    for cluster in clusters(scan.xyz, above):
        still[cluster] = not _was_passing(scan, cluster)
        if not still[cluster[0]]:
            passing.append(cluster)
    return np.flatnonzero(still), passing


def _was_passing(scan: Scan, cluster: I64) -> bool:
    """Whether a cluster classified as vehicle was there for a moment: rays say so, or it stands on the road."""
    if scan.moved[cluster].mean() > MOVED_SHARE or scan.passed[cluster].mean() > scan.seen[cluster].mean():
        return True
    if scan.brief[cluster].mean() < 0.5 or scan.height[cluster].min() > VEHICLE_BAND_M[0] + ROOF_GAP_M:
        return False
    box = fit_rectangle(scan.xyz[cluster, :2])
    low, high = scan.xyz[cluster, :2].min(axis=0) - ROAD_MARGIN_M, scan.xyz[cluster, :2].max(axis=0) + ROAD_MARGIN_M
    ground = scan.ground & ((scan.xyz[:, :2] > low) & (scan.xyz[:, :2] < high)).all(axis=1)
    ground = np.flatnonzero(ground)[box.inside(scan.xyz[ground, :2], ROAD_MARGIN_M)]
    return bool(len(ground)) and float((scan.classification[ground] == CODE["road"]).mean()) > ROAD_SHARE


def passing_points(scan: Scan) -> list[I64]:
    """Clusters (indices) of any class that were there for a moment, though the free space of voxels kept them.

    These are clusters above the ground, no wider than a lane, that were scanned only for a moment, and either rays of
    more sweeps passed their place than saw them, or they touch moving points: at the ends of a trail no ray passes. A
    garden seen through a gate is also scanned only for a moment, but it is wider; wires of a fence are passed by most
    rays, but they are thinner.
    """
    above = ~scan.ground & _between(scan.height, (MIN_HEIGHT_M, MAX_HEIGHT_M))
    above &= ~np.isin(scan.classification, STATIC_CLASSES)
    found = [c for c in clusters(scan.xyz, above & scan.brief) if _was_brief(scan, c)]
    return found + [c for c in clusters(scan.xyz, above) if scan.moved[c].mean() > 0.5]


def _was_brief(scan: Scan, cluster: I64) -> bool:
    box, seen = fit_rectangle(scan.xyz[cluster, :2]), float(scan.seen[cluster].mean())
    passed = seen < PASSING_SWEEPS_MAX and float(scan.passed[cluster].mean()) > seen
    if passed and FENCE_MAX_WIDTH_M < box.width < LANE_WIDTH_M:
        return True
    return scan.moved[cluster].mean() > TOUCHING_MOVED_SHARE and box.width < LANE_WIDTH_M


def people(scan: Scan) -> list[Instance]:
    """People: clusters of a person's size that are classified as person or moved."""
    return [candidate for candidate in _person_candidates(scan) if _is_person(scan, candidate)]


def rejected_person_points(scan: Scan) -> I64:
    """Indices of points classified as person in clusters of a person's size with mostly other classes."""
    classified = np.flatnonzero(scan.classification == CODE["person"])
    wrong = np.zeros(len(classified), bool)
    for candidate in _person_candidates(scan):
        if not _is_person(scan, candidate):
            low = scan.height[classified] < candidate.height + 0.1
            wrong |= candidate.box.inside(scan.xyz[classified, :2], BOX_MARGIN_M) & low
    return classified[wrong]


def _is_person(scan: Scan, candidate: Instance) -> bool:
    share = (scan.classification[candidate.index] == CODE["person"]).mean()
    return candidate.moved or float(share) > PERSON_SHARE


def _person_candidates(scan: Scan) -> list[Instance]:
    """Clusters of a person's size of which some points are classified as person."""
    tree = cKDTree(scan.xyz[:, :2])
    found = []
    for cluster in clusters(scan.xyz, ~scan.ground & (scan.classification == CODE["person"]) & (scan.height < 2.3)):
        box = fit_rectangle(scan.xyz[cluster, :2])
        top = float(scan.height[cluster].max())
        if not (box.length < 1.5 and 0.9 < top < 2.2):
            continue
        near = np.array(tree.query_ball_point((box.x, box.y), box.length / 2 + 0.3), np.int64)
        in_height = (scan.height[near] > MIN_HEIGHT_M) & (scan.height[near] < top + 0.1)
        own = near[box.inside(scan.xyz[near, :2], BOX_MARGIN_M) & in_height]
        centre = np.array([box.x, box.y, _ground_z(scan, own)])
        moved = float(scan.moved[own].mean()) > MOVED_SHARE
        found.append(Instance("person", centre, box.heading, box.length, box.width, top, 1.0, moved, own))
    return found


def _vehicle(scan: Scan, tree: cKDTree, above: Bools, cluster: I64) -> Instance | None:
    """The vehicle detected at a cluster; None if it is not a vehicle."""
    box = fit_rectangle(scan.xyz[cluster, :2])
    if not (1.0 < box.length < 40 and 0.4 < box.width < 4.5):
        return None
    near = np.array(tree.query_ball_point((box.x, box.y), np.hypot(box.length, box.width) / 2 + 3), np.int64)
    near = near[above[near]]
    within = near[box.inside(scan.xyz[near, :2], 0.0)]
    top = roof_height(scan.xyz[within, :2], scan.height[within])
    kind_and_odds = _kind(box, top)
    if kind_and_odds is None:
        return None
    kind, odds = kind_and_odds
    if kind != "part":
        box = _with_full_width(_extended(box, scan, near, top), scan.path)
    inside = near[box.inside(scan.xyz[near, :2], BOX_MARGIN_M) & (scan.height[near] < top + BOX_MARGIN_M)]
    body = inside[scan.height[inside] > VEHICLE_BAND_M[0]]
    if len(body) < MIN_VOXELS:
        return None
    mean_vote = float((scan.odds[body] * scan.weight[body]).sum() / scan.weight[body].sum())
    odds += PRIOR_LOG_ODDS + INDEPENDENT_VOTES * mean_vote + _free_end_odds(scan, near, box, top)
    if odds <= 0:
        return None
    classified = near[(scan.classification[near] == CODE["vehicle"]) & box.inside(scan.xyz[near, :2], MIRROR_MARGIN_M)]
    own = np.union1d(inside, classified[scan.height[classified] < top + ROOF_GAP_M])
    moved = float(scan.moved[own].mean()) > MOVED_SHARE
    centre = np.array([box.x, box.y, _ground_z(scan, own)])
    return Instance(kind, centre, box.heading, box.length, box.width, top, odds, moved, own)


def _kind(box: Rectangle, top: float) -> tuple[str, float] | None:
    """Kind of vehicle with the size of a box, and the log-likelihood ratio for a vehicle; None if no kind fits."""
    for kind in KINDS:
        if _within(top, kind.height) and _within(box.length, kind.length):
            if _within(box.width, kind.width, 0.15):
                return kind.name, kind.odds
            if box.width < kind.width[0]:
                return kind.name, kind.odds - 1.7  # scanned from one side
    if _within(top, (1.1, 2.0)) and box.length <= 5.6 and box.width <= 2.3:
        return "part", 0.0
    rows = (box.length > 5.6 and 1.4 < box.width < 2.6) or (box.length > 3.5 and 2.3 < box.width <= 5.6)
    return ("row", 0.0) if rows and _within(top, (1.2, 2.0)) and box.length < 30 else None


def _within(value: float, span: Span, slack: float = 0.1) -> bool:
    return span[0] - slack <= value <= span[1] + slack


def _extended(box: Rectangle, scan: Scan, near: I64, top: float) -> Rectangle:
    """A box extended at its ends by adjacent points of other classes, up to free space.

    The box is unchanged if it would become longer than a vehicle; points rising above the roof end the extension.
    """
    longest = max((k.length[1] for k in KINDS if _within(top, k.height) and _within(box.width, k.width)), default=0.0)
    u, v = box.to_local(scan.xyz[near])
    beyond = (np.abs(v) < box.width / 2) & (scan.height[near] > DOOR_BAND_M[0])
    ends = []
    for end in (-1, 1):
        out = end * u[beyond] - box.length / 2
        step = np.floor(out / CLUSTER_CELL_M).astype(np.int64)
        count = np.bincount(step[step >= 0], minlength=1)
        tall = np.bincount(step[step >= 0], scan.height[near][beyond][step >= 0] > top + ROOF_GAP_M, minlength=1)
        free = np.flatnonzero((count < 3) | (tall > 0))
        on = (step >= 0) & (step < (free[0] if len(free) else len(count)))
        ends.append(float(np.percentile(out[on], 95)) if on.any() else 0.0)
    if box.length + sum(ends) > longest + BOX_MARGIN_M:
        return box
    shift = (ends[1] - ends[0]) / 2
    x, y = box.x + shift * np.cos(box.heading), box.y + shift * np.sin(box.heading)
    return box._replace(x=float(x), y=float(y), length=box.length + sum(ends))


def _with_full_width(box: Rectangle, path: F64) -> Rectangle:
    """A box, widened to a vehicle's width away from the scanner if only one side of the vehicle was scanned."""
    if box.width >= MIN_FULL_WIDTH_M:
        return box
    nearest = path[np.argmin(np.hypot(path[:, 0] - box.x, path[:, 1] - box.y)), :2]
    across = np.array([-np.sin(box.heading), np.cos(box.heading)])
    away = np.sign(across @ (np.array([box.x, box.y]) - nearest)) or 1.0
    shift = across * away * (1.6 - box.width) / 2
    return Rectangle(box.x + shift[0], box.y + shift[1], box.heading, box.length, 1.6)


def _free_end_odds(scan: Scan, near: I64, box: Rectangle, top: float) -> float:
    """Log-likelihood ratio of a vehicle to a part of something larger, by the free space at the box's ends.

    The sides are not used: cars park along walls and hedges.
    """
    beside = near[_between(scan.height[near], (DOOR_BAND_M[0], min(top, 1.5)))]
    u, v = box.to_local(scan.xyz[beside, :2])
    out = np.abs(u) - box.length / 2
    ends = beside[(out > BOX_MARGIN_M) & (out < BOX_MARGIN_M + 2 * CLUSTER_CELL_M) & (np.abs(v) < box.width / 2)]
    cells = np.unique(np.floor(scan.xyz[ends, :2] / CLUSTER_CELL_M), axis=0)
    share = len(cells) * CLUSTER_CELL_M**2 / (2 * box.width * 2 * CLUSTER_CELL_M)
    return float(np.interp(share, END_OCCUPANCY, (1.0, -2.0)))


def roof_height(xy: F32, height: F32) -> float:
    """Height of the roof above ground in metres: the top of the points connected upwards from the height of doors.

    It is the 90th percentile of the heights of plan cells, so that a lamp post beside a hedge doesn't make it a van.
    """
    ordered = np.sort(height[height > DOOR_BAND_M[0]])
    if not len(ordered):
        return 0.0
    gaps = np.flatnonzero(np.diff(ordered) > ROOF_GAP_M)
    lid = ordered[gaps[0]] if len(gaps) else ordered[-1]
    chosen = (height > DOOR_BAND_M[0]) & (height <= lid)
    _, cell = np.unique(np.floor(xy[chosen] / CLUSTER_CELL_M), axis=0, return_inverse=True)
    tops = np.zeros(cell.max() + 1, np.float32)
    np.maximum.at(tops, cell.ravel(), height[chosen])
    return float(np.percentile(tops, 90))


def _ground_z(scan: Scan, index: I64) -> float:
    """Median z of the ground below points, local metres."""
    return float(np.median(scan.xyz[index, 2] - scan.height[index])) if len(index) else 0.0


def clusters(xyz: F32, member: Bools) -> Iterator[I64]:
    """Indices of the members of each component connected in plan with at least `MIN_VOXELS` points."""
    index = np.flatnonzero(member)
    if not len(index):
        return
    cell = np.floor((xyz[index, :2] - xyz[index, :2].min(axis=0)) / CLUSTER_CELL_M).astype(np.int64)
    plan = np.zeros(cell.max(axis=0) + 1, bool)
    plan[tuple(cell.T)] = True
    part = ndimage.label(plan, np.ones((3, 3)))[0][tuple(cell.T)]
    order = np.argsort(part, kind="stable")
    for cluster in np.split(index[order], np.flatnonzero(np.diff(part[order])) + 1):
        if len(cluster) >= MIN_VOXELS:
            yield cluster


def fit_rectangle(xy: F32) -> Rectangle:
    """L-shape fit: the rectangle whose sides points (N, 2) are closest to; tolerates 1 % of outliers at each side."""
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
