"""Pole-like objects: detection of poles and trunks in a cloud by their shape, and fitting of tubes.

The cloud above the ground is cut into horizontal slabs; in each slab, a small isolated cluster is a disc. Discs above
one another form a stem (after Brenner 2009, "Extraction of Features from Mobile Laser Scanning Data for Future Driver
Assistance Systems"). Point classes and photos are not used.

The radius comes from the width of the stem in each sweep of the scanner: across the line of sight, the returns of a
cylinder are uniformly distributed over its diameter, and neither the range noise nor errors of the poses between sweeps
change that width. The sweeps are registered on the stem, since pose errors of a few centimetres thicken a post
severalfold. Without times and a path of the scanner, circles are fitted to the points by least squares.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from scan2sim.pipeline.core.types import F32, F64, I64, Bools
from scan2sim.pipeline.geometry.sorting import stable_argsort


@dataclass(frozen=True)
class StemLimits:
    """Thresholds of stem detection."""

    cell_m: float = 0.1  # raster cell of a slab, and minimum gap around a disc: a voxel of D3.2
    slab_m: float = 0.25  # height of a slab: several beams of a scanner 20 m away cross it
    max_disc_m: float = 0.9  # largest diameter of a disc: a trunk
    noise_fraction: float = 0.1  # cells with fewer points than this part of the fullest neighbour are noise
    max_tilt: float = 0.15  # metres sideways per metre up
    max_axis_offset_m: float = 0.12  # distance of a disc from the axis of its stem: half of it may be occluded
    max_gap_m: float = 1.0  # length of a section without discs, where the stem touches a sign panel or a hedge
    min_free_slabs: float = 0.6  # minimum fraction of slabs with a disc
    min_slenderness: float = 4.0  # minimum ratio of length to diameter: excludes people
    radius_range_m: tuple[float, float] = (0.015, 0.45)  # from a steel tube to an old tree
    section_m: float = 0.5  # length of a section with a circle of its own
    max_wobble_m: float = 0.04  # deviation of disc centres from their neighbours' line: larger for foliage
    max_spread_m: float = 0.05  # standard deviation of points from the surface, over several drives
    clearance_m: float = 0.4  # radius around the stem for `min_own_fraction`
    min_own_fraction: float = 0.5  # minimum fraction of points in that radius that are the stem's, median over slabs
    max_foot_height_m: float = 1.5  # height of the lowest visible point: cars and hedges may occlude the foot
    min_points_per_slab: int = 6  # with fewer points, round stems and edges of walls look alike
    min_points: int = 20
    prior_points: float = 40.0  # weight of the whole stem's circle when the circle of a section is fitted
    sweep_gap_s: float = 0.02  # pause without returns from the stem between two sweeps
    sweep_max_s: float = 0.1  # longest time during which poses are taken as consistent, and the line of sight as fixed
    max_slope: float = 0.7  # of the depth across the line of sight, within sweeps: larger for walls seen at an angle
    min_sweep_width_points: int = 20  # minimum degrees of freedom of the width within sweeps


STEM = StemLimits()
CIRCLE_STARTS = ((0.0, 0.0), *((math.cos(a), math.sin(a)) for a in np.arange(6) * np.pi / 3))
"""Start positions of the centre of a circle relative to the median of its points."""


@dataclass(frozen=True)
class Stem:
    """An upright tube.

    Attributes:
        centre: (K, 3) points of its axis from bottom to top, local metres.
        radius: (K,) metres.
        spread: metres, standard deviation of its points from its surface.
        wobble: metres, standard deviation of its disc centres from the line through their neighbours.
    """

    centre: F64
    radius: F64
    spread: float
    wobble: float

    @property
    def length(self) -> float:
        """Length in metres between its lowest and highest observed points."""
        return float(self.centre[-1, 2] - self.centre[0, 2])

    @property
    def middle(self) -> F64:
        """Position (2,) of its axis at half its points, in plan view."""
        return self.centre[len(self.centre) // 2, :2]

    @property
    def thickness(self) -> float:
        """Median radius in metres."""
        return float(np.median(self.radius))

    def at(self, z: npt.ArrayLike) -> tuple[F64, F64]:
        """Axis (N, 2) and radius (N,) at heights z (N,), local metres; extrapolated linearly beyond its ends."""
        z = np.asarray(z, np.float64)
        up = self.centre[:, 2]
        slope = (self.centre[-1, :2] - self.centre[0, :2]) / max(up[-1] - up[0], 1e-6)
        beyond = (z - np.clip(z, up[0], up[-1]))[:, None] * slope
        xy = np.column_stack([np.interp(z, up, self.centre[:, k]) for k in (0, 1)]) + beyond
        return xy, np.interp(z, up, self.radius)

    def distance(self, xyz: npt.NDArray[np.floating]) -> F64:
        """Horizontal distance (N,) in metres of points (N, 3) from its surface; negative inside."""
        xy, radius = self.at(xyz[:, 2])
        return np.hypot(*(xyz[:, :2] - xy).T) - radius

    def covers(self, other: Stem) -> bool:
        """Whether the middle of another stem lies inside this one, or next to it without a gap."""
        z = np.array([(other.centre[0, 2] + other.centre[-1, 2]) / 2])
        apart = float(np.hypot(*(self.at(z)[0] - other.at(z)[0])[0]))
        return apart < self.thickness + other.thickness + STEM.cell_m

    def moved(self, by: F64) -> Stem:
        """The stem translated by (3,) metres."""
        return replace(self, centre=self.centre + by)

    def to_json(self) -> dict[str, Any]:
        """JSON object, the inverse of `from_json`."""
        fitted = {"spread": float(self.spread), "wobble": float(self.wobble)}
        return {"centre": self.centre.tolist(), "radius": self.radius.tolist(), **fitted}

    @classmethod
    def from_json(cls, row: Mapping[str, Any]) -> Stem:
        """Read the result of `to_json`."""
        return cls(np.array(row["centre"], np.float64), np.array(row["radius"]), row["spread"], row["wobble"])


@dataclass(frozen=True)
class Beams:
    """Time (N,) in seconds at which each point of a cloud was measured, and position (N, 2) of the scanner then."""

    time: F64
    scanner: F64


def stems(columns: Columns, height: F32, min_length: float, beams: Beams | None = None) -> list[Stem]:
    """Detect all stems of a cloud.

    Args:
        columns: index of its N points.
        height: (N,) metres above the ground.
        min_length: minimum length of a stem, metres.
        beams: of the N points; None: unknown.
    """
    xyz, found = columns.xyz, []
    for chain in _chains(_discs(columns.xyz, height), min_length):
        own = _points_of(columns, chain)
        stem = _fit(xyz[own], chain, beams and Beams(beams.time[own], beams.scanner[own]))
        if stem is not None:
            near = columns.near(stem.middle, 2 * STEM.clearance_m)
            if _is_stem(stem, xyz[near], height[near]):
                found.append(stem)
    return _without_duplicates(found)


def _is_stem(stem: Stem, xyz: F32, height: F32) -> bool:
    """Whether a tube is a stem: smooth, slender, near the ground, with dense points, and isolated."""
    if stem.length < STEM.min_slenderness * 2 * stem.thickness or stem.wobble > STEM.max_wobble_m:
        return False
    residual = stem.distance(xyz)
    margin = max(0.03, 2 * stem.spread)
    foot = height[(np.abs(residual) < margin) & (xyz[:, 2] < stem.centre[-1, 2])].min(initial=np.inf)
    at = (xyz[:, 2] > stem.centre[0, 2]) & (xyz[:, 2] < stem.centre[-1, 2])
    residual = residual[at]
    on = np.abs(residual) < margin
    slab = np.floor((xyz[at, 2] - stem.centre[0, 2]) / STEM.slab_m).astype(np.int64)
    count = int(slab.max(initial=0)) + 1
    own, around = (
        np.bincount(slab[on], minlength=count),
        np.bincount(slab[residual < STEM.clearance_m], minlength=count),
    )
    dense = own.sum() > STEM.min_points_per_slab * count
    return bool(
        dense and np.median(own / np.maximum(around, 1)) > STEM.min_own_fraction and foot < STEM.max_foot_height_m
    )


def _discs(xyz: F32, height: F32) -> F64:
    """Small isolated clusters (D, 5) per slab: x, y, z of the centre, slab index, and diameter in metres."""
    import cv2

    if not len(xyz):
        return np.zeros((0, 5))
    slab = np.floor(height / STEM.slab_m).astype(np.int64)
    column = np.floor(xyz[:, 0] / STEM.cell_m).astype(np.int64)
    row = np.floor(xyz[:, 1] / STEM.cell_m).astype(np.int64)
    column, row = column - column.min() + 1, row - row.min() + 1
    shape = int(row.max()) + 2, int(column.max()) + 2
    order, level = stable_argsort(slab - slab.min())
    starts = np.searchsorted(level, np.arange(level[-1] + 2))
    most = int(STEM.max_disc_m / STEM.cell_m)
    discs = []
    for first, last in pairwise(starts.tolist()):
        here = order[first:last]
        if not len(here):
            continue
        held = np.bincount(row[here] * shape[1] + column[here], minlength=shape[0] * shape[1])
        held = held.reshape(shape).astype(np.float32)
        image = ((held > 0) & (held >= STEM.noise_fraction * cv2.dilate(held, np.ones((5, 5))))).astype(np.uint8)
        count, part, stats, _ = cv2.connectedComponentsWithStats(image, connectivity=8, ltype=cv2.CV_32S)
        small = (stats[:, cv2.CC_STAT_WIDTH] <= most) & (stats[:, cv2.CC_STAT_HEIGHT] <= most)
        small[0] = False
        of = part[row[here], column[here]]
        in_small = small[of]
        of, here = of[in_small], here[in_small]
        n = np.maximum(np.bincount(of, minlength=count), 1)
        middle = [np.bincount(of, xyz[here, k], count) / n for k in range(3)]
        across = STEM.cell_m * np.maximum(stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT])
        discs.append(np.column_stack([*middle, np.full(count, slab[order[first]]), across])[small])
    return np.concatenate(discs) if discs else np.zeros((0, 5))


@dataclass(frozen=True)
class Chain:
    """Discs above one another on a straight axis.

    Attributes:
        foot, along: (2,) position of the axis at z = 0, and its change per metre of height.
        low, high: z of the lowest and the highest disc's edge, metres.
        free: (S,) z of the disc centres, metres.
        wobble: standard deviation of the disc centres from the line through their neighbours, metres.
        width: median diameter of the discs, metres.
    """

    foot: F64
    along: F64
    low: float
    high: float
    free: F64
    wobble: float
    width: float

    def at(self, z: npt.NDArray[np.floating]) -> F64:
        """Axis positions (N, 2) at heights (N,)."""
        return self.foot + np.asarray(z, np.float64)[:, None] * self.along


def _chains(discs: F64, min_length: float) -> list[Chain]:
    """Chains of discs along steep lines, the longest first; each disc belongs to at most one."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    if not len(discs):
        return []
    # z is compressed, so that one search radius allows for the gap upwards and the offset sideways
    squeezed = discs[:, :3] * (1, 1, STEM.max_axis_offset_m / STEM.max_gap_m)
    pairs = cKDTree(squeezed).query_pairs(1.2 * STEM.max_axis_offset_m, output_type="ndarray")
    links = coo_array((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(len(discs), len(discs)))
    count, group = connected_components(links, directed=False)
    order = np.argsort(group, kind="stable")
    bounds = np.searchsorted(group[order], np.arange(count + 1))
    chains = []
    for first, last in pairwise(bounds.tolist()):
        left = discs[order[first:last]]
        while (last - first) * STEM.slab_m >= STEM.min_free_slabs * min_length and len(
            left
        ) * STEM.slab_m >= STEM.min_free_slabs * min_length:
            on = _dominant_line(left)
            if on is None or on.sum() * STEM.slab_m < STEM.min_free_slabs * min_length:
                break
            run = _longest_run(left[on])
            if run is not None and len(np.unique(run[:, 3])) * STEM.slab_m >= STEM.min_free_slabs * min_length:
                low, high = run[:, 2].min() - STEM.slab_m / 2, run[:, 2].max() + STEM.slab_m / 2
                if high - low >= min_length:
                    along = np.array([np.polyfit(run[:, 2], run[:, k], 1) for k in (0, 1)])
                    width = float(np.median(run[:, 4]))
                    ends = float(low), float(high)
                    chains.append(Chain(along[:, 1], along[:, 0], *ends, run[:, 2], _wobble(run), width))
            left = left[~on]
    return sorted(chains, key=lambda chain: chain.low - chain.high)


def _dominant_line(discs: F64) -> Bools | None:
    """Discs (N,) bool on the steep line with most of them, among lines through (random) pairs of discs; or None."""
    n = len(discs)
    if n < 2:
        return None
    rng = np.random.default_rng(0)
    a, b = np.triu_indices(n, 1) if n <= 24 else rng.integers(0, n, (2, 300))
    rise = discs[b, 2] - discs[a, 2]
    steep = np.abs(rise) > 2 * STEM.slab_m
    a, b, rise = a[steep], b[steep], rise[steep]
    along = (discs[b, :2] - discs[a, :2]) / rise[:, None]
    steep = np.hypot(*along.T) < STEM.max_tilt
    a, along = a[steep], along[steep]
    if not len(a):
        return None
    at = discs[a, None, :2] + (discs[None, :, 2] - discs[a, None, 2])[..., None] * along[:, None]
    on = np.hypot(*np.moveaxis(at - discs[None, :, :2], -1, 0)) < STEM.max_axis_offset_m
    return np.asarray(on[on.sum(axis=1).argmax()])


def _longest_run(discs: F64) -> F64 | None:
    """Longest run of discs of similar width without a gap above `max_gap_m`; None if too few slabs have a disc."""
    discs = discs[
        discs[:, 4] <= np.median(discs[:, 4]) + 1.5 * STEM.cell_m
    ]  # wider discs include a sign panel, or touch another object
    discs = discs[np.argsort(discs[:, 2], kind="stable")]
    cuts = np.flatnonzero(np.diff(discs[:, 2]) > STEM.max_gap_m + STEM.slab_m) + 1
    runs = [run for run in np.split(discs, cuts) if len(run) > 2]
    if not runs:
        return None
    run = max(runs, key=lambda r: float(r[-1, 2] - r[0, 2]))
    filled = len(np.unique(run[:, 3])) / (run[:, 3].max() - run[:, 3].min() + 1)
    return run if filled >= STEM.min_free_slabs else None


def _wobble(run: F64) -> float:
    """Standard deviation of disc centres from the line through the discs above and below (robust), metres."""
    bend = run[1:-1, :2] - (run[:-2, :2] + run[2:, :2]) / 2
    return 1.48 / math.sqrt(1.5) * float(np.median(np.abs(bend)))


def _points_of(columns: Columns, chain: Chain) -> I64:
    """Indices of the points in the discs of a chain."""
    near = columns.near(chain.at(np.array([(chain.low + chain.high) / 2]))[0], STEM.max_disc_m + 0.4)
    z = columns.xyz[near, 2]
    level = np.searchsorted(chain.free, z).clip(1, len(chain.free) - 1)
    apart = np.minimum(np.abs(z - chain.free[level - 1]), np.abs(z - chain.free[level]))
    aside = np.hypot(*(columns.xyz[near, :2] - chain.at(z)).T)
    return near[(apart <= STEM.slab_m / 2) & (aside < chain.width / 2 + STEM.cell_m)]


class Columns:
    """Spatial index of points in plan view (cells of 1 m2), for neighbourhood queries.

    Args:
        xyz: (N, 3) local metres.
    """

    def __init__(self, xyz: F32) -> None:
        self.xyz = xyz
        self._low = np.floor(xyz[:, :2].min(axis=0)).astype(np.int32)
        at = np.floor(xyz[:, :2]).astype(np.int64) - self._low
        self._size = at.max(axis=0) + 1
        self._order, code = stable_argsort(at[:, 0] * self._size[1] + at[:, 1])
        self._start = np.searchsorted(code, np.arange(int(self._size.prod()) + 1))

    def near(self, place: F64, radius: float) -> I64:
        """Indices of the points in the square with half side `radius` around a position (2,)."""
        first = np.clip(np.floor(place - radius).astype(int) - self._low, 0, self._size - 1)
        last = np.clip(np.floor(place + radius).astype(int) - self._low, 0, self._size - 1)
        rows = np.arange(first[0], last[0] + 1) * self._size[1]
        index = np.concatenate([self._order[self._start[r + first[1]] : self._start[r + last[1] + 1]] for r in rows])
        return index[(np.abs(self.xyz[index, :2] - place) <= radius).all(axis=1)]


def _fit(xyz: F32, chain: Chain, beams: Beams | None) -> Stem | None:
    """Fit a tube to the points of a chain; None if they are too few or not round."""
    if len(xyz) < STEM.min_points:
        return None
    flat = xyz[:, :2] - chain.at(xyz[:, 2])  # projected along the axis
    sections = np.linspace(chain.low, chain.high, max(2, round((chain.high - chain.low) / STEM.section_m) + 1))
    near = [np.abs(xyz[:, 2] - z) < STEM.section_m for z in sections]
    middle = chain.at(np.array([(chain.low + chain.high) / 2]))
    fitted = None if beams is None else _fit_sweeps(flat, near, replace(beams, scanner=beams.scanner - middle))
    fitted = fitted or _fit_circles(flat, np.floor((xyz[:, 2] - chain.low) / STEM.slab_m), near)
    if fitted is None or fitted.spread > max_spread(float(np.median(fitted.radius))):
        return None
    radius = np.clip(fitted.radius, *STEM.radius_range_m)
    axis = np.column_stack([chain.at(sections) + fitted.centre, sections])
    return Stem(axis, radius, fitted.smear, chain.wobble)


def max_spread(radius: float) -> float:
    """Maximum standard deviation in metres of the points of a stem from its surface."""
    return min(STEM.max_spread_m, 0.6 * radius + 0.015)


@dataclass(frozen=True)
class Fitted:
    """Circles of the sections of a stem.

    Attributes:
        centre: (K, 2) relative to the axis of the chain, metres.
        radius: (K,) metres.
        spread: standard deviation of the registered points from the surface, metres.
        smear: the same of the points as they are in the cloud.
    """

    centre: F64
    radius: F64
    spread: float
    smear: float


def _fit_sweeps(flat: F64, near: list[Bools], beams: Beams) -> Fitted | None:
    """Circles from the widths within the sweeps; None if they have too few points, or the width is out of range.

    Args:
        flat: (N, 2) points, projected along the axis.
        near: of each section, its points (N,).
        beams: of the points; the scanner's positions relative to the axis.
    """
    sweep, count = _sweeps(beams.time)
    away = -np.column_stack([np.bincount(sweep, beams.scanner[:, k]) for k in (0, 1)]) / count[:, None]
    away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
    axes = np.stack([np.column_stack([-away[:, 1], away[:, 0]]), away], axis=1)  # of a sweep: across, and away
    seen = np.einsum("nij,nj->ni", axes[sweep], flat)
    offset = seen[:, 0] - _medians(seen[:, 0], sweep)[sweep]
    radius, on = 2 * float(np.median(np.abs(offset[count[sweep] > 2]))) if (count > 2).any() else 0.0, count[sweep] > 0
    for _ in range(4):  # uniformly distributed: the standard deviation is the radius over the root of 3
        on = np.abs(offset) < 1.25 * radius + 0.02
        n = np.bincount(sweep[on], minlength=len(count))
        offset = seen[:, 0] - (np.bincount(sweep[on], seen[on, 0], len(count)) / np.maximum(n, 1))[sweep]
        freedom = int(np.maximum(n - 1, 0).sum())
        if freedom < STEM.min_sweep_width_points:
            return None
        radius = math.sqrt(3 * float((offset[on] ** 2)[n[sweep[on]] > 1].sum()) / freedom)
    behind = seen[:, 1] - _medians(seen[:, 1], sweep)[sweep]
    slope = float((offset * behind)[on].sum() / max((offset**2)[on].sum(), 1e-12))
    is_post = STEM.radius_range_m[0] / 2 <= radius <= STEM.radius_range_m[1] and abs(slope) < STEM.max_slope
    if not is_post or on.mean() < 0.5:
        return None
    # the median point of half a cylinder is at this depth in front of the axis
    depth = _medians(seen[on, 1], sweep[on], len(count)) + math.sqrt(3) / 2 * radius
    across = np.bincount(sweep[on], seen[on, 0], len(count)) / np.maximum(n, 1)
    target, weight = np.stack([across, depth], axis=1), n.astype(np.float64)
    A = np.einsum("n,nij,nik->jk", weight, axes, axes) + 1e-9 * np.eye(2)
    middle = np.linalg.solve(A, np.einsum("n,nij,ni->j", weight, axes, target))
    error = target - axes @ middle
    shift = _shrunk(error, weight, (radius / math.sqrt(3), 0.02))
    registered = flat - middle - np.einsum("nij,ni->nj", axes, shift)[sweep]

    def spread(points: F64) -> float:
        return 1.48 * float(np.median(np.abs(np.hypot(*points.T) - radius)))

    centres, radii = np.empty((len(near), 2)), np.empty(len(near))
    for i, section in enumerate(near):
        here = section & on
        part = axes[sweep[here]]
        u = np.einsum("nij,nj->ni", part, registered[here])
        u[:, 1] += np.sqrt(np.maximum(radius**2 - u[:, 0] ** 2, 0))
        A = np.einsum("nij,nik->jk", part, part) + STEM.prior_points * np.eye(2)
        centres[i] = middle + np.linalg.solve(A, np.einsum("nij,ni->j", part, u))
        square = 3 * float((offset[here] ** 2).sum()) * on.sum() / freedom + STEM.prior_points * radius**2
        radii[i] = math.sqrt(square / (here.sum() + STEM.prior_points))
    return Fitted(centres, radii, spread(registered[on]), spread(flat[on] - middle))


def _sweeps(time: F64) -> tuple[I64, I64]:
    """Number of the sweep of each point (N,), and number of points of each sweep."""
    order = np.argsort(time, kind="stable")
    ordered = time[order]
    start = np.concatenate([[True], np.diff(ordered) > STEM.sweep_gap_s])
    since = ordered - ordered[start][np.cumsum(start) - 1]
    key = (np.cumsum(start) - 1) * 1e6 + np.floor(since / STEM.sweep_max_s)
    sweep = np.empty(len(time), np.int64)
    sweep[order] = np.unique(key, return_inverse=True)[1]
    return sweep, np.bincount(sweep)


def _medians(values: F64, group: I64, count: int | None = None) -> F64:
    """Median of the values (N,) of each group; 0 for empty ones."""
    out = np.zeros(int(group.max(initial=-1)) + 1 if count is None else count)
    order = np.lexsort((values, group))
    first = np.searchsorted(group[order], np.arange(len(out) + 1))
    held = np.diff(first) > 0
    middle = (first[:-1] + first[1:] - 1) / 2
    low, high = np.floor(middle[held]).astype(int), np.ceil(middle[held]).astype(int)
    out[held] = (values[order[low]] + values[order[high]]) / 2
    return out


def _shrunk(error: F64, weight: F64, noise: tuple[float, float]) -> F64:
    """Pose errors (K, 2) of sweeps: measured ones, reduced by the share that noise explains.

    Args:
        error: (K, 2) measured offsets of the sweeps, across and along the line of sight, metres.
        weight: (K,) number of points.
        noise: standard deviation of one point in each direction, metres.
    """
    variance = np.average(error**2, axis=0, weights=weight)
    random = np.array(noise) ** 2 / np.maximum(weight, 1)[:, None]
    pose = np.maximum(variance - np.average(random, axis=0, weights=weight), 0)
    return np.asarray(error * pose / np.maximum(pose + random, 1e-12))


def _fit_circles(flat: F64, slab: F64, near: list[Bools]) -> Fitted | None:
    """Circles fitted to points (N, 2) of all sweeps together, in slabs (N,); None if they are not round.

    `near`: of each section, its points (N,).
    """
    level = np.unique(slab, return_inverse=True)[1]
    weight = 1.0 / np.bincount(level)[level]  # equal weight of all slabs: one with a sign panel has many more points
    middle, radius = fit_circle(flat, weight / weight.mean())
    residual = np.abs(np.hypot(*(flat - middle).T) - radius)
    spread = 1.48 * float(np.median(residual))
    on = residual < max(3 * spread, 0.02)
    if not STEM.radius_range_m[0] <= radius <= STEM.radius_range_m[1] or on.mean() < 0.5:
        return None
    fits = [refine_circle(flat[s & on], np.ones((s & on).sum()), middle, radius, 8, STEM.prior_points) for s in near]
    return Fitted(np.array([c for c, _ in fits]), np.array([r for _, r in fits]), spread, spread)


def fit_circle(xy: F64, weight: F64) -> tuple[F64, float]:
    """Fit a circle to weighted points (N, 2) by robust least squares; returns its centre (2,) and radius.

    Started from circles of several sizes on all sides of the points, since scanners see one side only.
    """
    centre = np.median(xy, axis=0)
    sample = slice(None, None, max(1, len(xy) // 200))
    best, middle, radius = np.inf, centre, 0.0
    for r0 in (0.04, 0.1, 0.22):
        for away in CIRCLE_STARTS:
            m, r = refine_circle(xy[sample], weight[sample], centre + 0.75 * r0 * np.array(away), r0, 5, 0.0)
            residual = np.abs(np.hypot(*(xy[sample] - m).T) - r)
            score = float((residual.clip(max=0.05) * weight[sample]).sum())
            if score < best and STEM.radius_range_m[0] / 2 <= r <= 1.2 * STEM.radius_range_m[1]:
                best, middle, radius = score, m, r
    return refine_circle(xy, weight, middle, radius, 8, 0.0) if radius else (middle, radius)


@njit(cache=True)
def refine_circle(
    xy: F64, weight: F64, middle: F64, radius: float, steps: int, prior_weight: float
) -> tuple[F64, float]:
    """Refine a circle by Gauss-Newton with Tukey's biweight; returns its centre (2,) and radius.

    Args:
        xy, weight: points (N, 2) and weights (N,).
        middle, radius: initial circle, which is also the prior.
        steps: maximum number of iterations.
        prior_weight: weight of the prior, in points.
    """
    at = np.array([middle[0], middle[1], radius])
    held = at.copy()
    if len(xy) < 3:
        return at[:2], at[2]
    far, residual = np.empty(len(xy)), np.empty(len(xy))
    for _ in range(steps):
        for i in range(len(xy)):
            far[i] = max(math.hypot(xy[i, 0] - at[0], xy[i, 1] - at[1]), 1e-6)
            residual[i] = far[i] - at[2]
        limit = max(6.0 * np.median(np.abs(residual)), 0.02)
        A, g = np.eye(3) * (prior_weight + 1e-6), prior_weight * (at - held)
        for i in range(len(xy)):
            if abs(residual[i]) < limit:
                w = weight[i] * (1 - (residual[i] / limit) ** 2) ** 2
                j = np.array([(at[0] - xy[i, 0]) / far[i], (at[1] - xy[i, 1]) / far[i], -1.0])
                for k in range(3):
                    g[k] += w * j[k] * residual[i]
                    for m in range(3):
                        A[k, m] += w * j[k] * j[m]
        step = _solve3(A, g)
        largest = np.abs(step).max()
        at -= step * min(1.0, 0.1 / max(largest, 1e-9))
        at[2] = abs(at[2])
        if largest < 1e-4:
            break
    return at[:2], at[2]


@njit(cache=True)
def _solve3(A: F64, g: F64) -> F64:
    """Solution (3,) of a symmetric 3x3 system by Cramer's rule."""
    a, b, c, d, e, f = A[0, 0], A[0, 1], A[0, 2], A[1, 1], A[1, 2], A[2, 2]
    p, q, r = d * f - e * e, c * e - b * f, b * e - c * d
    det = a * p + b * q + c * r
    s, t, u = a * f - c * c, b * c - a * e, a * d - b * b
    x = p * g[0] + q * g[1] + r * g[2]
    y = q * g[0] + s * g[1] + t * g[2]
    z = r * g[0] + t * g[1] + u * g[2]
    return np.array([x, y, z]) / (det if abs(det) > 1e-18 else 1e-18)


def _without_duplicates(found: list[Stem]) -> list[Stem]:
    """Remove stems that lie inside a longer one."""
    kept: list[Stem] = []
    for stem in sorted(found, key=lambda s: -s.length):
        if not any(other.covers(stem) for other in kept):
            kept.append(stem)
    return kept
