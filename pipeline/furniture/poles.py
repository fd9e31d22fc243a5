"""What stands upright and thin: poles and trunks, found in a cloud by their shape alone, and fitted by tubes.

Above the ground the cloud is cut into slabs; in each, what is small and has room around is a disc. Discs above one
another make a stem (after Brenner 2009, "Extraction of Features from Mobile Laser Scanning Data for Future Driver
Assistance Systems"). Circles are fitted by least squares to what lies near its axis, slab by slab where there are
enough points. Nothing here knows classes or photos.
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
from scan2sim.pipeline.geometry.sorting import ordered

CELL = 0.1
"""Metres: discs have a gap around them at least so wide, which is a voxel of the mission's."""
SLAB = 0.25
"""Metres of a slab's height: beams of a scanner 20 m away cross it."""
WIDEST = 0.9
"""Metres across of a disc: a trunk's."""
FAINT = 0.1
"""Cells with less than this share of the points of the fullest one beside them are noise between things."""
LEAN = 0.15
"""How far a stem leans at most, metres a metre."""
ASIDE = 0.12
"""Metres that a disc may lie beside its stem's axis: half of it may be hidden."""
GAP = 1.0
"""Metres of a stem in which it may touch other things: a plate, a hedge."""
FILLED = 0.6
"""Share of its slabs in which a stem must stand free."""
SLIM = 4.0
"""A stem is at least this many times as long as it is thick: nobody is."""
RADII = (0.015, 0.45)
"""Metres: from a steel tube to an old tree."""
LENGTH = 0.5
"""Metres of a stem that share a circle."""
STEADY = 0.04
"""Metres that the middles of a stem's discs may lie beside where those above and below put them: leaves do."""
NOISE = 0.05
"""Metres: points of a smooth thing lie no further from it (standard deviation), be they of several drives."""
CLEAR = 0.4
"""Metres around a stem in which ..."""
ALONE = 0.5
"""... at least this share of the points is its own, in most slabs."""
FOOT = 1.5
"""Metres above the ground within which a stem is seen; below, cars and hedges may hide it."""
PER_SLAB = 6
"""Points of a stem in each slab: fewer don't tell round things from edges of walls."""
FEWEST = 20
"""Points of a stem."""
STARTS = ((0.0, 0.0), *((math.cos(a), math.sin(a)) for a in np.arange(6) * np.pi / 3))
"""Where the middle of a circle may lie beside the middle of its points."""
FIRM = 40.0
"""Points that the whole stem's circle counts for where a part's own is fitted."""


@dataclass(frozen=True)
class Stem:
    """An upright tube.

    Attributes:
        centre: (K, 3) its axis from below to above, local metres.
        radius: (K,) metres.
        spread: metres, standard deviation of its points from its surface.
        wobble: metres, standard deviation of its discs' middles from where their neighbours put them.
    """

    centre: F64
    radius: F64
    spread: float
    wobble: float

    @property
    def length(self) -> float:
        """Metres from the lowest to the highest place where it was seen."""
        return float(self.centre[-1, 2] - self.centre[0, 2])

    @property
    def middle(self) -> F64:
        """(2,) of its axis, on the ground plan."""
        return self.centre[len(self.centre) // 2, :2]

    @property
    def thickness(self) -> float:
        """Metres: its radius at half height."""
        return float(np.median(self.radius))

    def at(self, z: npt.ArrayLike) -> tuple[F64, F64]:
        """Axis (N, 2) and radius (N,) at heights z (N,), local metres; straight on beyond its ends."""
        z = np.asarray(z, np.float64)
        up = self.centre[:, 2]
        slope = (self.centre[-1, :2] - self.centre[0, :2]) / max(up[-1] - up[0], 1e-6)
        beyond = (z - np.clip(z, up[0], up[-1]))[:, None] * slope
        xy = np.column_stack([np.interp(z, up, self.centre[:, k]) for k in (0, 1)]) + beyond
        return xy, np.interp(z, up, self.radius)

    def distance(self, xyz: npt.NDArray[np.floating]) -> F64:
        """(N,) metres of points (N, 3) from its surface, sideways; negative inside."""
        xy, radius = self.at(xyz[:, 2])
        return np.hypot(*(xyz[:, :2] - xy).T) - radius

    def covers(self, other: Stem) -> bool:
        """Whether the middle of another one stands within it, or beside it without a gap."""
        z = np.array([(other.centre[0, 2] + other.centre[-1, 2]) / 2])
        apart = float(np.hypot(*(self.at(z)[0] - other.at(z)[0])[0]))
        return apart < self.thickness + other.thickness + CELL

    def moved(self, by: F64) -> Stem:
        """It by (3,) metres elsewhere."""
        return replace(self, centre=self.centre + by)

    def to_json(self) -> dict[str, Any]:
        """As `from_json` reads it."""
        fitted = {"spread": float(self.spread), "wobble": float(self.wobble)}
        return {"centre": self.centre.tolist(), "radius": self.radius.tolist(), **fitted}

    @classmethod
    def from_json(cls, row: Mapping[str, Any]) -> Stem:
        """What `to_json` told."""
        return cls(np.array(row["centre"], np.float64), np.array(row["radius"]), row["spread"], row["wobble"])


def stems(columns: Columns, height: F32, least: float) -> list[Stem]:
    """All stems of a cloud.

    Args:
        columns: of its N points.
        height: (N,) metres above the ground; only points within reach of things that stand there.
        least: metres that a stem is long at least.
    """
    xyz, found = columns.xyz, []
    for chain in _chains(_discs(columns.xyz, height), least):
        stem = _fit(xyz[_around(columns, chain)], chain)
        if stem is not None:
            near = columns.near(stem.middle, 2 * CLEAR)
            if _stands(stem, xyz[near], height[near]):
                found.append(stem)
    return _once(found)


def _stands(stem: Stem, xyz: F32, height: F32) -> bool:
    """Whether a tube is one that stands: smooth, slim, from near the ground up, dense with points, with room around."""
    if stem.length < SLIM * 2 * stem.thickness or stem.wobble > STEADY:
        return False
    if stem.spread > min(NOISE, 0.6 * stem.thickness + 0.015):
        return False
    at = (xyz[:, 2] > stem.centre[0, 2]) & (xyz[:, 2] < stem.centre[-1, 2])
    off = stem.distance(xyz[at])
    on = np.abs(off) < max(0.03, 2 * stem.spread)
    slab = np.floor((xyz[at, 2] - stem.centre[0, 2]) / SLAB).astype(np.int64)
    count = int(slab.max(initial=0)) + 1
    own, around = np.bincount(slab[on], minlength=count), np.bincount(slab[off < CLEAR], minlength=count)
    dense = own.sum() > PER_SLAB * count
    return bool(dense and np.median(own / np.maximum(around, 1)) > ALONE and height[at][on].min() < FOOT)


def _discs(xyz: F32, height: F32) -> F64:
    """(D, 5) x, y, z of the middle, slab, and metres across, of what is small and stands free in a slab."""
    import cv2

    if not len(xyz):
        return np.zeros((0, 5))
    slab = np.floor(height / SLAB).astype(np.int64)
    column = np.floor(xyz[:, 0] / CELL).astype(np.int64)
    row = np.floor(xyz[:, 1] / CELL).astype(np.int64)
    column, row = column - column.min() + 1, row - row.min() + 1
    shape = int(row.max()) + 2, int(column.max()) + 2
    order, level = ordered(slab - slab.min())
    starts = np.searchsorted(level, np.arange(level[-1] + 2))
    most = int(WIDEST / CELL)
    discs = []
    for first, last in pairwise(starts.tolist()):
        here = order[first:last]
        if not len(here):
            continue
        held = np.bincount(row[here] * shape[1] + column[here], minlength=shape[0] * shape[1])
        held = held.reshape(shape).astype(np.float32)
        image = ((held > 0) & (held >= FAINT * cv2.dilate(held, np.ones((5, 5))))).astype(np.uint8)
        count, part, stats, _ = cv2.connectedComponentsWithStats(image, connectivity=8, ltype=cv2.CV_32S)
        small = (stats[:, cv2.CC_STAT_WIDTH] <= most) & (stats[:, cv2.CC_STAT_HEIGHT] <= most)
        small[0] = False
        of = part[row[here], column[here]]
        in_small = small[of]
        of, here = of[in_small], here[in_small]
        n = np.maximum(np.bincount(of, minlength=count), 1)
        middle = [np.bincount(of, xyz[here, k], count) / n for k in range(3)]
        across = CELL * np.maximum(stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT])
        discs.append(np.column_stack([*middle, np.full(count, slab[order[first]]), across])[small])
    return np.concatenate(discs) if discs else np.zeros((0, 5))


@dataclass(frozen=True)
class Chain:
    """Discs above one another.

    Attributes:
        foot, along: (2,) place at z = 0 and its change a metre up.
        low, high: metres, z of the lowest and the highest disc's edge.
        free: (S,) metres, z of the middles of the discs, where nothing else is near.
        wobble: metres, standard deviation of the discs' middles from where those above and below put them.
    """

    foot: F64
    along: F64
    low: float
    high: float
    free: F64
    wobble: float

    def at(self, z: npt.NDArray[np.floating]) -> F64:
        """(N, 2) its axis at heights (N,)."""
        return self.foot + np.asarray(z, np.float64)[:, None] * self.along


def _chains(discs: F64, least: float) -> list[Chain]:
    """Straight, steep lines through discs, the longest first; each disc belongs to one."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    if not len(discs):
        return []
    # steps up are drawn in so far that what lies within GAP above and a little aside is near
    squeezed = discs[:, :3] * (1, 1, ASIDE / GAP)
    pairs = cKDTree(squeezed).query_pairs(1.2 * ASIDE, output_type="ndarray")
    links = coo_array((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(len(discs), len(discs)))
    count, group = connected_components(links, directed=False)
    order = np.argsort(group, kind="stable")
    bounds = np.searchsorted(group[order], np.arange(count + 1))
    chains = []
    for first, last in pairwise(bounds.tolist()):
        left = discs[order[first:last]]
        while (last - first) * SLAB >= FILLED * least and len(left) * SLAB >= FILLED * least:
            on = _line(left)
            if on is None or on.sum() * SLAB < FILLED * least:
                break
            run = _longest(left[on])
            if run is not None and len(np.unique(run[:, 3])) * SLAB >= FILLED * least:
                low, high = run[:, 2].min() - SLAB / 2, run[:, 2].max() + SLAB / 2
                if high - low >= least:
                    along = np.array([np.polyfit(run[:, 2], run[:, k], 1) for k in (0, 1)])
                    chains.append(Chain(along[:, 1], along[:, 0], float(low), float(high), run[:, 2], _rough(run)))
            left = left[~on]
    return sorted(chains, key=lambda chain: chain.low - chain.high)


def _line(discs: F64) -> Bools | None:
    """The discs on the steep line that most of them lie on, of all through two of them (or of many such); or None."""
    n = len(discs)
    if n < 2:
        return None
    rng = np.random.default_rng(0)
    a, b = np.triu_indices(n, 1) if n <= 24 else rng.integers(0, n, (2, 300))
    rise = discs[b, 2] - discs[a, 2]
    steep = np.abs(rise) > 2 * SLAB
    a, b, rise = a[steep], b[steep], rise[steep]
    along = (discs[b, :2] - discs[a, :2]) / rise[:, None]
    steep = np.hypot(*along.T) < LEAN
    a, along = a[steep], along[steep]
    if not len(a):
        return None
    at = discs[a, None, :2] + (discs[None, :, 2] - discs[a, None, 2])[..., None] * along[:, None]
    on = np.hypot(*np.moveaxis(at - discs[None, :, :2], -1, 0)) < ASIDE
    return np.asarray(on[on.sum(axis=1).argmax()])


def _longest(discs: F64) -> F64 | None:
    """The longest run of discs without a gap of more than `GAP` that fills enough of its slabs; none much wider."""
    discs = discs[discs[:, 4] <= np.median(discs[:, 4]) + 1.5 * CELL]  # those hold a plate, or touch something
    discs = discs[np.argsort(discs[:, 2], kind="stable")]
    cuts = np.flatnonzero(np.diff(discs[:, 2]) > GAP + SLAB) + 1
    runs = [run for run in np.split(discs, cuts) if len(run) > 2]
    if not runs:
        return None
    run = max(runs, key=lambda r: float(r[-1, 2] - r[0, 2]))
    filled = len(np.unique(run[:, 3])) / (run[:, 3].max() - run[:, 3].min() + 1)
    return run if filled >= FILLED else None


def _rough(run: F64) -> float:
    """Metres, standard deviation of discs' middles from where those above and below put them."""
    bend = run[1:-1, :2] - (run[:-2, :2] + run[2:, :2]) / 2
    return 1.48 / math.sqrt(1.5) * float(np.median(np.abs(bend)))


def _around(columns: Columns, chain: Chain) -> I64:
    """The points of a chain's discs."""
    near = columns.near(chain.at(np.array([(chain.low + chain.high) / 2]))[0], WIDEST + 0.4)
    z = columns.xyz[near, 2]
    level = np.searchsorted(chain.free, z).clip(1, len(chain.free) - 1)
    apart = np.minimum(np.abs(z - chain.free[level - 1]), np.abs(z - chain.free[level]))
    aside = np.hypot(*(columns.xyz[near, :2] - chain.at(z)).T)
    return near[(apart <= SLAB / 2) & (aside < WIDEST / 2 + ASIDE)]


class Columns:
    """Points sorted by square metre of the ground plan, to look for those around a place.

    Args:
        xyz: (N, 3) local metres.
    """

    def __init__(self, xyz: F32) -> None:
        self.xyz = xyz
        self._low = np.floor(xyz[:, :2].min(axis=0)).astype(np.int32)
        at = np.floor(xyz[:, :2]).astype(np.int64) - self._low
        self._size = at.max(axis=0) + 1
        self._order, code = ordered(at[:, 0] * self._size[1] + at[:, 1])
        self._start = np.searchsorted(code, np.arange(int(self._size.prod()) + 1))

    def near(self, place: F64, radius: float) -> I64:
        """Indices of the points in the square of twice the radius around a place (2,)."""
        first = np.clip(np.floor(place - radius).astype(int) - self._low, 0, self._size - 1)
        last = np.clip(np.floor(place + radius).astype(int) - self._low, 0, self._size - 1)
        rows = np.arange(first[0], last[0] + 1) * self._size[1]
        index = np.concatenate([self._order[self._start[r + first[1]] : self._start[r + last[1] + 1]] for r in rows])
        return index[(np.abs(self.xyz[index, :2] - place) <= radius).all(axis=1)]


def _fit(xyz: F32, chain: Chain) -> Stem | None:
    """A tube around the points of a chain; None where they are not round, or are none."""
    if len(xyz) < FEWEST:
        return None
    xyz = xyz.astype(np.float64)
    flat = xyz[:, :2] - chain.at(xyz[:, 2])  # as seen along the axis
    slab = np.unique(np.floor((xyz[:, 2] - chain.low) / SLAB), return_inverse=True)[1]
    held = np.bincount(slab)
    weight = 1.0 / held[slab]  # all slabs say as much: a plate in one of them is dense
    middle, radius = circle(flat, weight / weight.mean())
    off = np.abs(np.hypot(*(flat - middle).T) - radius)
    spread = 1.48 * float(np.median(off))
    on = off < max(3 * spread, 0.02)
    if not RADII[0] <= radius <= RADII[1] or on.mean() < 0.5:
        return None
    count = max(2, round((chain.high - chain.low) / LENGTH) + 1)
    z = np.linspace(chain.low, chain.high, count)
    centres, radii = np.empty((count, 2)), np.empty(count)
    for i, level in enumerate(z):
        here = on & (np.abs(xyz[:, 2] - level) < LENGTH)
        centres[i], radii[i] = refined(flat[here], np.ones(here.sum()), middle, radius, 8, FIRM)
    return Stem(np.column_stack([chain.at(z) + centres, z]), np.clip(radii, *RADII), spread, chain.wobble)


def circle(xy: F64, weight: F64) -> tuple[F64, float]:
    """A circle, middle (2,) and radius, through points (N, 2) of some weight by robust least squares.

    It begins with circles of several sizes on all sides of the points, since scanners see one side.
    """
    centre = np.median(xy, axis=0)
    some = slice(None, None, max(1, len(xy) // 200))
    best, middle, radius = np.inf, centre, 0.0
    for r0 in (0.04, 0.1, 0.22):
        for away in STARTS:
            m, r = refined(xy[some], weight[some], centre + 0.75 * r0 * np.array(away), r0, 5, 0.0)
            off = np.abs(np.hypot(*(xy[some] - m).T) - r)
            score = float((off.clip(max=0.05) * weight[some]).sum())
            if score < best and RADII[0] / 2 <= r <= 1.2 * RADII[1]:
                best, middle, radius = score, m, r
    return refined(xy, weight, middle, radius, 8, 0.0) if radius else (middle, radius)


@njit(cache=True)
def refined(xy: F64, weight: F64, middle: F64, radius: float, steps: int, firm: float) -> tuple[F64, float]:
    """A circle, middle (2,) and radius, moved to points by Gauss and Newton's method, outliers weighed down (Tukey).

    Args:
        xy, weight: (N, 2) and (N,).
        middle, radius: where it begins, and what it is held to.
        steps: at most.
        firm: as strongly as this many points it is held there.
    """
    at = np.array([middle[0], middle[1], radius])
    held = at.copy()
    if len(xy) < 3:
        return at[:2], at[2]
    far, off = np.empty(len(xy)), np.empty(len(xy))
    for _ in range(steps):
        for i in range(len(xy)):
            far[i] = max(math.hypot(xy[i, 0] - at[0], xy[i, 1] - at[1]), 1e-6)
            off[i] = far[i] - at[2]
        limit = max(6.0 * np.median(np.abs(off)), 0.02)
        A, g = np.eye(3) * (firm + 1e-6), firm * (at - held)
        for i in range(len(xy)):
            if abs(off[i]) < limit:
                w = weight[i] * (1 - (off[i] / limit) ** 2) ** 2
                j = np.array([(at[0] - xy[i, 0]) / far[i], (at[1] - xy[i, 1]) / far[i], -1.0])
                for k in range(3):
                    g[k] += w * j[k] * off[i]
                    for m in range(3):
                        A[k, m] += w * j[k] * j[m]
        step = _solved(A, g)
        largest = np.abs(step).max()
        at -= step * min(1.0, 0.1 / max(largest, 1e-9))
        at[2] = abs(at[2])
        if largest < 1e-4:
            break
    return at[:2], at[2]


@njit(cache=True)
def _solved(A: F64, g: F64) -> F64:
    """(3,) solution of a symmetric system of three, by Cramer's rule."""
    a, b, c, d, e, f = A[0, 0], A[0, 1], A[0, 2], A[1, 1], A[1, 2], A[2, 2]
    p, q, r = d * f - e * e, c * e - b * f, b * e - c * d
    det = a * p + b * q + c * r
    s, t, u = a * f - c * c, b * c - a * e, a * d - b * b
    x = p * g[0] + q * g[1] + r * g[2]
    y = q * g[0] + s * g[1] + t * g[2]
    z = r * g[0] + t * g[1] + u * g[2]
    return np.array([x, y, z]) / (det if abs(det) > 1e-18 else 1e-18)


def _once(found: list[Stem]) -> list[Stem]:
    """Stems without those that stand within another, the longest first."""
    kept: list[Stem] = []
    for stem in sorted(found, key=lambda s: -s.length):
        if not any(other.covers(stem) for other in kept):
            kept.append(stem)
    return kept
