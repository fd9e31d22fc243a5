"""Road model: reference line, markings, edges and heights of a road, fitted to the observations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from scan2sim.pipeline.core.types import F64, I64
from scan2sim.pipeline.roads import clothoid, driven, kerbs, observed, paint, profile
from scan2sim.pipeline.roads.clothoid import Clothoids
from scan2sim.pipeline.roads.observed import EXTENSION_M, Observed
from scan2sim.pipeline.roads.profile import Profile

MAX_SURFACE_DISTANCE_M = 3.0
"""Distance from the reference line within which heights and cross slopes are fitted."""
MIN_ROAD_LENGTH_M = 8.0


@dataclass(frozen=True)
class ModelLimits:
    """Parameters of the road model."""

    knot_spacing_m: float = 10.0  # of profiles, approximate
    line_sigma_m: float = 0.03  # noise of observed lines
    line_bend_m: float = 0.05  # expected deviation of a line from a straight one between two knots
    height_sigma_m: float = 0.02  # noise of heights
    cross_slope_change: float = 0.005  # expected change of a cross slope between two knots
    max_stroke_gap_m: float = 12.5  # between strokes of one line: US broken lines have 9 m, German motorways 12 m
    max_stroke_offset_m: float = 0.15  # lateral offset of a stroke from the previous one ...
    max_stroke_drift: float = 0.01  # ... plus this per metre of gap
    min_paint_m: float = 3.0  # length of paint in a line
    min_paint_fraction: float = 0.24  # of the length of a line
    min_line_length_m: float = 6.0
    max_dash_m: float = 8.0  # dashes are shorter (6 m on motorways)
    dash_tolerance: float = 0.25  # of dashes and gaps in a broken line, relative to their period
    edge_tolerance_m: float = 0.3  # distance of observations that support an edge
    edge_support_m: float = 3.0  # distance along the road over which an observation supports an edge
    min_edge_fraction: float = 0.4  # part of the road's length along which an edge must be supported
    max_centre_offset: float = 0.25  # of a centre line from the middle, relative to the width
    kerb_stone_m: float = 0.12  # lines within this distance of an edge are kerb stones
    min_kerb_fraction: float = 0.2  # part of a line with height steps from which it is a line of kerb stones


LIMITS = ModelLimits()


Reference = Literal["marking", "middle", "way"]


@dataclass(frozen=True)
class Line:
    """A line along the road.

    Attributes:
        kind: "marking", or the road's "left" or "right" edge.
        offset: offset from the reference line, metres, positive to its left.
        ranges: (first, last) chainages between which it was observed.
        marking: "solid" or "broken", for a marking.
        width: width of the paint, metres.
        dash, gap: metres, for a broken line; first: chainage of the beginning of a dash.
        kerb: height of the kerb, metres; None: the edge is a boundary to other ground.
        deviation: 95th percentile of the distance of its observations, metres.
        seen: (M, 2) chainages and offsets of its observations.
    """

    kind: Literal["marking", "left", "right"]
    offset: Profile
    ranges: tuple[tuple[float, float], ...]
    deviation: float
    seen: F64
    marking: Literal["solid", "broken"] | None = None
    width: float | None = None
    dash: float | None = None
    gap: float | None = None
    first: float | None = None
    kerb: float | None = None

    @property
    def span(self) -> tuple[float, float]:
        """First and last chainage."""
        return self.ranges[0][0], self.ranges[-1][1]


@dataclass(frozen=True)
class Road:
    """A road.

    Attributes:
        line: reference line.
        reference: source of the reference line: painted centre line, middle between the edges, or driven way.
        height: height of the reference line above the frame's origin, metres.
        cross_slopes: slopes of the surface to the left and to the right, positive if it rises outwards.
        markings: markings from left to right.
        left, right: edges; None: unknown.
        keeps_right: whether the way was driven on the right side of the centre line.
    """

    line: Clothoids
    reference: Reference
    height: Profile
    cross_slopes: tuple[Profile, Profile]
    markings: tuple[Line, ...]
    left: Line | None
    right: Line | None
    keeps_right: bool = True


Warn = Callable[[str], None]


def ignore_warning(warning: str) -> None:
    """A `Warn` that ignores warnings."""


def network(ways: Sequence[Observed], origin: Sequence[float], warn: Warn = ignore_warning) -> list[Road]:
    """Roads along all ways (world metres), joined across tile borders, in metres from `origin` (3,)."""
    joined = observed.join([way.moved(-np.asarray(origin)) for way in ways])
    return [road for way in joined if (road := build_road(way, warn))]


def build_road(seen: Observed, warn: Warn = ignore_warning) -> Road | None:
    """Build the road along a way; None if its observations are shorter than `MIN_ROAD_LENGTH_M`.

    A road without surface points near its reference line has no heights: it is omitted, with a warning.
    """
    places = driven.extend(seen.way, EXTENSION_M)
    base = clothoid.fit(clothoid.approximate(places), places)
    seen = _kerb_stones_to_edges(base, seen)
    markings, left, right = _lines(base, seen)
    centre = _centre(markings, left, right)
    lines = [one for one in (*markings, left, right) if one]
    if not lines:
        return None
    line: Clothoids = base
    reference: Reference = "way"
    if centre is not None:
        line, reference = clothoid.fit(base, base.points(*centre.seen.T)), "marking"
    elif left and right and len(middle := _between(base, left, right)) >= MIN_ROAD_LENGTH_M:
        line, reference = clothoid.fit(base, middle), "middle"
    ends = [base.points([s], [one.offset.at(s)]) for one in lines for s in one.span]
    chainage = line.locate(np.concatenate(ends))[0]
    first, last = max(0.0, float(chainage.min())), min(line.length, float(chainage.max()))
    if last - first < MIN_ROAD_LENGTH_M:
        return None
    line = line.part(first, last)
    markings, left, right = _lines(line, seen)
    surface = _surface(line, seen.ground)
    if surface is None:
        warn(
            f"a road of {line.length:.0f} m is left out: no point of its surface is within "
            f"{MAX_SURFACE_DISTANCE_M:g} m of its line"
        )
        return None
    height, cross_slopes = surface
    _, t = line.locate(seen.way)
    return Road(line, reference, height, cross_slopes, tuple(markings), left, right, bool(np.median(t) < 0.5))


def _lines(line: Clothoids, seen: Observed) -> tuple[list[Line], Line | None, Line | None]:
    """Markings from left to right, and edges, along a line."""
    knots = np.linspace(0, line.length, max(1, round(line.length / LIMITS.knot_spacing_m)) + 1)
    ground = line.locate(seen.ground)[0].clip(0, line.length)
    length = float(np.ptp(ground)) if len(ground) else line.length
    left, right = (_edge(line, seen, knots, side, length) for side in (1, -1))
    s, t = line.locate(seen.paint)
    inside = (s >= 0) & (s <= line.length)
    for edge, side in ((left, 1), (right, -1)):
        if edge is not None:
            inside &= (edge.offset.at(s) - t) * side > LIMITS.kerb_stone_m
    markings = _markings(knots, s[inside], t[inside], seen.stroke[inside], seen.width[inside])
    return sorted(markings, key=_mean, reverse=True), left, right


def _kerb_stones_to_edges(line: Clothoids, seen: Observed) -> Observed:
    """Convert bright lines of kerb stones, which were detected as paint, to edges.

    They are recognized by height steps beside them; where there is no step, the kerb is dropped.
    """
    s, t = line.locate(seen.paint)
    at, offset = line.locate(seen.edge[:, :2])
    stepped = np.isfinite(seen.edge[:, 3])
    paint_, edge = np.ones(len(s), bool), [seen.edge]
    for group in _link_strokes(s, t, seen.stroke):
        own = np.isin(seen.stroke, group)
        for side in (1, -1):
            steps = stepped & (seen.edge[:, 2] == side) & (at > s[own].min()) & (at < s[own].max())
            nearest = np.abs(at[steps][:, None] - s[own]).argmin(axis=1) if steps.any() else np.zeros(0, int)
            beyond = (t[own][nearest] - offset[steps]) * side
            along = (beyond > -LIMITS.kerb_stone_m / 2) & (beyond < 2 * LIMITS.kerb_stone_m)
            if along.sum() * kerbs.ROW_M > LIMITS.min_kerb_fraction * np.ptp(s[own]):
                places = line.points(s[own], t[own] - side * float(np.median(beyond[along])))
                edge.append(np.column_stack([places, np.full(len(places), side), np.zeros(len(places))]))
                paint_ &= ~own
    whole = np.ones(len(seen.ground), bool)
    return replace(seen.kept(paint_, np.ones(len(seen.edge), bool), whole), edge=np.concatenate(edge))


def _edge(line: Clothoids, seen: Observed, knots: F64, side: int, length: float) -> Line | None:
    """The edge on a side: a kerb if it continues along the road, else the boundary to other ground."""
    s, t = line.locate(seen.edge[:, :2])
    held = (seen.edge[:, 2] == side) & (s >= 0) & (s <= line.length)
    s, t, step = s[held], t[held], seen.edge[held, 3]
    stepped = np.isfinite(step)
    for used in (stepped, np.ones(len(s), bool)):
        if used.sum() < 3:
            continue
        offset = profile.fit(knots, s[used], t[used], LIMITS.line_sigma_m, LIMITS.line_bend_m)
        away = np.abs(t - offset.at(s))
        close = used & (away < LIMITS.edge_tolerance_m)
        ranges = _supported_ranges(s[close], line.length)
        far = sum(b - a for a, b in ranges)
        if far >= LIMITS.min_edge_fraction * length or (
            far >= LIMITS.min_line_length_m and close.sum() > used.sum() / 2
        ):
            high = step[close & (step > 0)]
            kerb = float(np.median(high)) if (close & stepped).sum() > close.sum() / 2 and len(high) else None
            deviation = float(np.percentile(away[close], 95))
            points = np.column_stack([s, t])[close]
            return Line("left" if side == 1 else "right", offset, ranges, deviation, points, kerb=kerb)
    return None


def _supported_ranges(s: F64, length: float) -> tuple[tuple[float, float], ...]:
    """Ranges of chainage in which a line is supported by observations at chainages (M,)."""
    if not len(s):
        return ()
    s = np.sort(s)
    breaks = np.flatnonzero(np.diff(s) > 2 * LIMITS.edge_support_m)
    firsts, lasts = s[np.append(0, breaks + 1)], s[np.append(breaks, len(s) - 1)]
    ends = ((max(0.0, a - 0.5), min(length, b + 0.5)) for a, b in zip(firsts.tolist(), lasts.tolist(), strict=True))
    return tuple((a, b) for a, b in ends if b - a > LIMITS.edge_support_m)


def _markings(knots: F64, s: F64, t: F64, stroke: I64, width: F64) -> list[Line]:
    """Markings: chains of strokes, from points (N,) with chainage, offset and stroke."""
    found = []
    for group in _link_strokes(s, t, stroke):
        for part in _split_by_type(s, stroke, group):
            own, ends = np.isin(stroke, part), _stroke_ends(s, stroke, part)
            painted, span = float((ends[:, 1] - ends[:, 0]).sum()), float(ends[-1, 1] - ends[0, 0])
            if (
                painted < LIMITS.min_paint_m
                or span < LIMITS.min_line_length_m
                or painted < LIMITS.min_paint_fraction * span
            ):
                continue
            offset = profile.fit(knots, s[own], t[own], LIMITS.line_sigma_m, LIMITS.line_bend_m)
            deviation = float(np.percentile(np.abs(t[own] - offset.at(s[own])), 95))
            points = np.column_stack([s, t])[own]
            ranges = ((max(0.0, float(ends[0, 0])), min(float(knots[-1]), float(ends[-1, 1]))),)
            broken = _dash_pattern(ends)
            wide = round(float(np.median(width[own])), 2)
            marking: Literal["solid", "broken"] = "broken" if broken else "solid"
            found.append(Line("marking", offset, ranges, deviation, points, marking, wide, *(broken or ())))
    return found


def _stroke_ends(s: F64, stroke: I64, group: list[int]) -> F64:
    """Chainages (K, 2) of the ends of strokes."""
    return np.array([(s[stroke == k].min() - paint.ROW_M / 2, s[stroke == k].max() + paint.ROW_M / 2) for k in group])


def _split_by_type(s: F64, stroke: I64, group: list[int]) -> list[list[int]]:
    """Split the strokes of a line where it changes between broken and solid."""
    long = np.diff(_stroke_ends(s, stroke, group), axis=1)[:, 0] > LIMITS.max_dash_m
    breaks = np.flatnonzero(np.diff(long)) + 1
    runs = [list(run) for run in np.split(np.array(group), breaks)]
    if all(len(run) > 2 or long[group.index(run[0])] for run in runs):
        return runs
    return [group]


def _link_strokes(s: F64, t: F64, stroke: I64) -> list[list[int]]:
    """Groups of strokes that continue each other across gaps."""
    numbers = [k for k in np.unique(stroke).tolist() if (stroke == k).sum() > 1]
    ends = {k: (s[own := stroke == k].argmin(), s[own].argmax(), own) for k in numbers}
    begin = {k: (float(s[own][a]), float(t[own][a])) for k, (a, _, own) in ends.items()}
    end = {k: (float(s[own][b]), float(t[own][b])) for k, (_, b, own) in ends.items()}
    groups: list[list[int]] = []
    for k in sorted(numbers, key=lambda k: begin[k][0]):
        misses = []
        for group in groups:
            at, offset = end[group[-1]]
            gap, miss = begin[k][0] - at, abs(begin[k][1] - offset)
            if (
                -0.5 < gap < LIMITS.max_stroke_gap_m
                and miss < LIMITS.max_stroke_offset_m + LIMITS.max_stroke_drift * gap
            ):
                misses.append((miss, group))
        if misses:
            min(misses, key=lambda found: found[0])[1].append(k)
        else:
            groups.append([k])
    return groups


def _dash_pattern(ends: F64) -> tuple[float, float, float] | None:
    """Dash length, gap length and chainage of a dash's beginning of strokes (K, 2); None if they form no broken line.

    The first and the last stroke may be cut off, so their lengths are not used.
    """
    if len(ends) < 3:
        return None
    dashes, gaps = (ends[1:-1, 1] - ends[1:-1, 0]), ends[1:, 0] - ends[:-1, 1]
    dash, gap = float(np.median(dashes)), float(np.median(gaps))
    regular = [
        np.mean(np.abs(x - middle) < LIMITS.dash_tolerance * (dash + gap)) > 0.5
        for x, middle in ((dashes, dash), (gaps, gap))
    ]
    if not all(regular) or gap < 0.25:
        return None
    phase = np.angle(np.mean(np.exp(2j * np.pi * ends[1:, 0] / (dash + gap)))) / (2 * np.pi) * (dash + gap)
    return round(dash, 2), round(gap, 2), float(phase % (dash + gap))


def _mean(line: Line) -> float:
    return float(np.mean(line.seen[:, 1]))


def _centre(markings: list[Line], left: Line | None, right: Line | None) -> Line | None:
    """Painted centre line: the marking nearest to the middle of the outermost lines, or of the edges; or None."""
    if not markings:
        return None
    outer = [markings[0], markings[-1]] if len(markings) > 2 else [one for one in (left, right) if one]
    if len(outer) < 2:
        return None
    low, high = sorted(map(_mean, outer))
    nearest = min(markings, key=lambda one: abs(_mean(one) - (low + high) / 2))
    return nearest if abs(_mean(nearest) - (low + high) / 2) < LIMITS.max_centre_offset * (high - low) else None


def _between(line: Clothoids, left: Line, right: Line) -> F64:
    """Points (N, 2) midway between the edges, one per metre, where both were observed."""
    s = np.arange(0.5, line.length, 1.0)
    both = np.all([np.any([(s >= a) & (s <= b) for a, b in one.ranges], axis=0) for one in (left, right)], axis=0)
    return line.points(s[both], ((left.offset.at(s) + right.offset.at(s)) / 2)[both])


def _surface(line: Clothoids, ground: F64) -> tuple[Profile, tuple[Profile, Profile]] | None:
    """Height of the reference line, and cross slopes to the left and right; None without ground near the line."""
    knots = np.linspace(0, line.length, max(1, round(line.length / LIMITS.knot_spacing_m)) + 1)
    s, t = line.locate(ground)
    held = (s > -1) & (s < line.length + 1)
    s, t, z = s[held], t[held], ground[held, 2]
    near = np.abs(t) < MAX_SURFACE_DISTANCE_M
    if not near.any():
        return None
    factors = np.column_stack([np.ones(len(t)), t.clip(0, None), (-t).clip(0, None)])[near]
    height, left, right = profile.fit_sum(
        knots,
        s[near],
        factors,
        z[near],
        LIMITS.height_sigma_m,
        [LIMITS.line_bend_m, LIMITS.cross_slope_change, LIMITS.cross_slope_change],
    )
    return height, (left, right)


def surface(road: Road, s: F64, t: F64) -> F64:
    """Points (N, 3) on a road's surface, local metres."""
    slope = np.where(t > 0, road.cross_slopes[0].at(s), road.cross_slopes[1].at(s))
    return np.column_stack([road.line.points(s, t), road.height.at(s) + slope * np.abs(t)])
