"""A road drawn from what was seen of it: reference line, painted lines, edges, heights."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from scan2sim.pipeline.core.types import F64, I64
from scan2sim.pipeline.roads import clothoid, driven, kerbs, observed, paint, profile
from scan2sim.pipeline.roads.clothoid import Clothoids
from scan2sim.pipeline.roads.observed import BEYOND, Observed
from scan2sim.pipeline.roads.profile import Profile

KNOT = 10.0
"""Metres, about, between places where cubics meet."""
NOISE, BEND = 0.03, 0.05
"""Metres: of what is seen of a line; by which a line leaves its straight course between two knots."""
LEVEL = 0.02
"""Metres: noise of heights."""
FALL = 0.005
"""By which the slope to a side changes between two knots."""
NEAR = 3.0
"""Metres from the reference line within which the surface's slopes are looked at."""
LONGEST_GAP = 12.5
"""Metres between strokes of one line: a US broken line has 9, a German motorway 12."""
MEETS, TURNS = 0.15, 0.01
"""Metres by which a stroke may miss its line's course, and by metre of the gap between them."""
PAINTED = 3.0
"""Metres of paint in a line, at least; SHARE of its length; its LENGTH."""
SHARE, LENGTH = 0.24, 6.0
DASH = 8.0
"""Metres: a dash is shorter (6 m on motorways)."""
REGULAR = 0.25
"""Share by which dashes and gaps of a broken line differ, at most."""
CLOSE = 0.3
"""Metres within which a place bears an edge out."""
BORNE = 3.0
"""Metres along the road from such a place within which an edge is told."""
MOSTLY = 0.4
"""Share of a road's length along which an edge must be told, to be told at all."""
CENTRAL = 0.25
"""Share of the width by which a line may be off the middle to be the centre line."""
BESIDE = 0.12
"""Metres from an edge within which what looks like a line is the kerb's stone."""
STONE = 0.2
"""Share of a line along which there is a step, from which on it is of kerb stones, lowered elsewhere."""
SHORTEST = 8.0
"""Metres of road that are told of."""


Reference = Literal["marking", "middle", "way"]


@dataclass(frozen=True)
class Line:
    """A line along the road.

    Attributes:
        kind: "marking", or the road's "left" or "right" edge.
        offset: from the reference line, metres to its left.
        told: (first, last) chainages of where it was seen.
        marking: "solid" or "broken", of a marking.
        width: metres of paint.
        dash, gap: metres, of a broken line; first: chainage of a dash's beginning.
        kerb: metres of the step; None: the edge is where other ground begins.
        deviation: metres from the line within which 95 % of what was seen of it lie.
        seen: (M, 2) chainages and offsets of that.
    """

    kind: Literal["marking", "left", "right"]
    offset: Profile
    told: tuple[tuple[float, float], ...]
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
        return self.told[0][0], self.told[-1][1]


@dataclass(frozen=True)
class Road:
    """A road.

    Attributes:
        line: its reference, and
        reference: what that is: the painted centre line, the middle between the edges, or the way that was driven.
        height: of the reference line, metres above the frame's origin.
        falls: slope of the surface to the left and to the right, metres a metre outwards.
        markings: from left to right.
        left, right: the edges; None: not told.
        keeps_right: whether the way was driven on the right of the centre line.
    """

    line: Clothoids
    reference: Reference
    height: Profile
    falls: tuple[Profile, Profile]
    markings: tuple[Line, ...]
    left: Line | None
    right: Line | None
    keeps_right: bool = True


Warn = Callable[[str], None]


def unheard(warning: str) -> None:
    """A `Warn` that ignores warnings."""


def network(ways: Sequence[Observed], origin: Sequence[float], warn: Warn = unheard) -> list[Road]:
    """Roads along all ways (world metres), continued over borders of tiles; metres from `origin` (3,)."""
    joined = observed.joined([way.moved(-np.asarray(origin)) for way in ways])
    return [road for way in joined if (road := drawn(way, warn))]


def drawn(seen: Observed, warn: Warn = unheard) -> Road | None:
    """The road along a way; None where nothing is seen of it over `SHORTEST` metres.

    A road whose lines are seen, but no point of its surface beside the reference line, has no heights: it is left out,
    with a warning.
    """
    places = driven.extended(seen.way, BEYOND)
    base = clothoid.fit(clothoid.through(places), places)
    seen = _with_stones(base, seen)
    markings, left, right = _lines(base, seen)
    centre = _centre(markings, left, right)
    lines = [one for one in (*markings, left, right) if one]
    if not lines:
        return None
    line: Clothoids = base
    reference: Reference = "way"
    if centre is not None:
        line, reference = clothoid.fit(base, base.places(*centre.seen.T)), "marking"
    elif left and right and len(middle := _between(base, left, right)) >= SHORTEST:
        line, reference = clothoid.fit(base, middle), "middle"
    ends = [base.places([s], [one.offset.at(s)]) for one in lines for s in one.span]
    chainage = line.locate(np.concatenate(ends))[0]
    first, last = max(0.0, float(chainage.min())), min(line.length, float(chainage.max()))
    if last - first < SHORTEST:
        return None
    line = line.part(first, last)
    markings, left, right = _lines(line, seen)
    surface = _surface(line, seen.ground)
    if surface is None:
        warn(f"a road of {line.length:.0f} m is left out: no point of its surface is within {NEAR:g} m of its line")
        return None
    height, falls = surface
    _, t = line.locate(seen.way)
    return Road(line, reference, height, falls, tuple(markings), left, right, bool(np.median(t) < 0.5))


def _lines(line: Clothoids, seen: Observed) -> tuple[list[Line], Line | None, Line | None]:
    """Markings from left to right, and the edges, along a line."""
    knots = np.linspace(0, line.length, max(1, round(line.length / KNOT)) + 1)
    ground = line.locate(seen.ground)[0].clip(0, line.length)
    length = float(np.ptp(ground)) if len(ground) else line.length
    left, right = (_edge(line, seen, knots, side, length) for side in (1, -1))
    s, t = line.locate(seen.paint)
    inside = (s >= 0) & (s <= line.length)
    for edge, side in ((left, 1), (right, -1)):
        if edge is not None:
            inside &= (edge.offset.at(s) - t) * side > BESIDE
    markings = _markings(knots, s[inside], t[inside], seen.stroke[inside], seen.width[inside])
    return sorted(markings, key=_mean, reverse=True), left, right


def _with_stones(line: Clothoids, seen: Observed) -> Observed:
    """What was seen, but that light lines of kerb stones are edges and not paint.

    They are told by steps of the ground beside them; where there is none, the kerb is lowered.
    """
    s, t = line.locate(seen.paint)
    at, offset = line.locate(seen.edge[:, :2])
    stepped = np.isfinite(seen.edge[:, 3])
    paint_, edge = np.ones(len(s), bool), [seen.edge]
    for group in _linked(s, t, seen.stroke):
        own = np.isin(seen.stroke, group)
        for side in (1, -1):
            steps = stepped & (seen.edge[:, 2] == side) & (at > s[own].min()) & (at < s[own].max())
            nearest = np.abs(at[steps][:, None] - s[own]).argmin(axis=1) if steps.any() else np.zeros(0, int)
            beyond = (t[own][nearest] - offset[steps]) * side
            along = (beyond > -BESIDE / 2) & (beyond < 2 * BESIDE)
            if along.sum() * kerbs.ROW > STONE * np.ptp(s[own]):
                places = line.places(s[own], t[own] - side * float(np.median(beyond[along])))
                edge.append(np.column_stack([places, np.full(len(places), side), np.zeros(len(places))]))
                paint_ &= ~own
    whole = np.ones(len(seen.ground), bool)
    return replace(seen.kept(paint_, np.ones(len(seen.edge), bool), whole), edge=np.concatenate(edge))


def _edge(line: Clothoids, seen: Observed, knots: F64, side: int, length: float) -> Line | None:
    """The edge on a side, by its kerb where that goes on along the road, else by where other ground begins."""
    s, t = line.locate(seen.edge[:, :2])
    held = (seen.edge[:, 2] == side) & (s >= 0) & (s <= line.length)
    s, t, step = s[held], t[held], seen.edge[held, 3]
    stepped = np.isfinite(step)
    for used in (stepped, np.ones(len(s), bool)):
        if used.sum() < 3:
            continue
        offset = profile.fit(knots, s[used], t[used], NOISE, BEND)
        away = np.abs(t - offset.at(s))
        close = used & (away < CLOSE)
        told = _stretches(s[close], line.length)
        far = sum(b - a for a, b in told)
        if far >= MOSTLY * length or (far >= LENGTH and close.sum() > used.sum() / 2):
            high = step[close & (step > 0)]
            kerb = float(np.median(high)) if (close & stepped).sum() > close.sum() / 2 and len(high) else None
            deviation = float(np.percentile(away[close], 95))
            points = np.column_stack([s, t])[close]
            return Line("left" if side == 1 else "right", offset, told, deviation, points, kerb=kerb)
    return None


def _stretches(s: F64, length: float) -> tuple[tuple[float, float], ...]:
    """Where a line is told, by the chainages (M,) that bear it out."""
    if not len(s):
        return ()
    s = np.sort(s)
    breaks = np.flatnonzero(np.diff(s) > 2 * BORNE)
    firsts, lasts = s[np.append(0, breaks + 1)], s[np.append(breaks, len(s) - 1)]
    ends = ((max(0.0, a - 0.5), min(length, b + 0.5)) for a, b in zip(firsts.tolist(), lasts.tolist(), strict=True))
    return tuple((a, b) for a, b in ends if b - a > BORNE)


def _markings(knots: F64, s: F64, t: F64, stroke: I64, width: F64) -> list[Line]:
    """Lines of paint: strokes in a row, as (chainage, offset) (N,) by stroke."""
    found = []
    for group in _linked(s, t, stroke):
        for part in _alike(s, stroke, group):
            own, ends = np.isin(stroke, part), _ends(s, stroke, part)
            painted, span = float((ends[:, 1] - ends[:, 0]).sum()), float(ends[-1, 1] - ends[0, 0])
            if painted < PAINTED or span < LENGTH or painted < SHARE * span:
                continue
            offset = profile.fit(knots, s[own], t[own], NOISE, BEND)
            deviation = float(np.percentile(np.abs(t[own] - offset.at(s[own])), 95))
            points = np.column_stack([s, t])[own]
            told = ((max(0.0, float(ends[0, 0])), min(float(knots[-1]), float(ends[-1, 1]))),)
            broken = _rhythm(ends)
            wide = round(float(np.median(width[own])), 2)
            marking: Literal["solid", "broken"] = "broken" if broken else "solid"
            found.append(Line("marking", offset, told, deviation, points, marking, wide, *(broken or ())))
    return found


def _ends(s: F64, stroke: I64, group: list[int]) -> F64:
    """(K, 2) chainages of the ends of strokes."""
    return np.array([(s[stroke == k].min() - paint.ROW / 2, s[stroke == k].max() + paint.ROW / 2) for k in group])


def _alike(s: F64, stroke: I64, group: list[int]) -> list[list[int]]:
    """A line's strokes, parted where a broken line becomes a solid one."""
    long = np.diff(_ends(s, stroke, group), axis=1)[:, 0] > DASH
    breaks = np.flatnonzero(np.diff(long)) + 1
    runs = [list(run) for run in np.split(np.array(group), breaks)]
    if all(len(run) > 2 or long[group.index(run[0])] for run in runs):
        return runs
    return [group]


def _linked(s: F64, t: F64, stroke: I64) -> list[list[int]]:
    """Strokes that go on in each other, over gaps."""
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
            if -0.5 < gap < LONGEST_GAP and miss < MEETS + TURNS * gap:
                misses.append((miss, group))
        if misses:
            min(misses, key=lambda found: found[0])[1].append(k)
        else:
            groups.append([k])
    return groups


def _rhythm(ends: F64) -> tuple[float, float, float] | None:
    """Dash, gap and the chainage of a dash's beginning of strokes (K, 2); None: they are no broken line.

    The first and the last stroke may be cut off, and so tell nothing.
    """
    if len(ends) < 3:
        return None
    dashes, gaps = (ends[1:-1, 1] - ends[1:-1, 0]), ends[1:, 0] - ends[:-1, 1]
    dash, gap = float(np.median(dashes)), float(np.median(gaps))
    regular = [
        np.mean(np.abs(x - middle) < REGULAR * (dash + gap)) > 0.5 for x, middle in ((dashes, dash), (gaps, gap))
    ]
    if not all(regular) or gap < 0.25:
        return None
    phase = np.angle(np.mean(np.exp(2j * np.pi * ends[1:, 0] / (dash + gap)))) / (2 * np.pi) * (dash + gap)
    return round(dash, 2), round(gap, 2), float(phase % (dash + gap))


def _mean(line: Line) -> float:
    return float(np.mean(line.seen[:, 1]))


def _centre(markings: list[Line], left: Line | None, right: Line | None) -> Line | None:
    """The painted centre line: what is nearest to the middle of the outermost lines, or of the edges; None: none is."""
    if not markings:
        return None
    outer = [markings[0], markings[-1]] if len(markings) > 2 else [one for one in (left, right) if one]
    if len(outer) < 2:
        return None
    low, high = sorted(map(_mean, outer))
    nearest = min(markings, key=lambda one: abs(_mean(one) - (low + high) / 2))
    return nearest if abs(_mean(nearest) - (low + high) / 2) < CENTRAL * (high - low) else None


def _between(line: Clothoids, left: Line, right: Line) -> F64:
    """(N, 2) places midway between the edges, a metre apart, where both are told."""
    s = np.arange(0.5, line.length, 1.0)
    both = np.all([np.any([(s >= a) & (s <= b) for a, b in one.told], axis=0) for one in (left, right)], axis=0)
    return line.places(s[both], ((left.offset.at(s) + right.offset.at(s)) / 2)[both])


def _surface(line: Clothoids, ground: F64) -> tuple[Profile, tuple[Profile, Profile]] | None:
    """The reference line's height, and the slopes to the left and to the right; None without ground beside the line."""
    knots = np.linspace(0, line.length, max(1, round(line.length / KNOT)) + 1)
    s, t = line.locate(ground)
    held = (s > -1) & (s < line.length + 1)
    s, t, z = s[held], t[held], ground[held, 2]
    near = np.abs(t) < NEAR
    if not near.any():
        return None
    factors = np.column_stack([np.ones(len(t)), t.clip(0, None), (-t).clip(0, None)])[near]
    height, left, right = profile.fit_sum(knots, s[near], factors, z[near], LEVEL, [BEND, FALL, FALL])
    return height, (left, right)
