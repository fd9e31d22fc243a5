"""Lines as roads are built: chains of clothoids, whose curvature changes evenly along them (Euler spirals)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F64

KNOT = 5.0
"""Metres, about, between places where the rate of curvature may change."""
NOISE = 0.1
"""Metres by which places lie off the line: how much is believed of each."""
RATE = 2e-4
"""Change of curvature along the line, 1/m2, that is expected of a road (a clothoid of parameter A = 70 m); where a
corner asks for more, it is had at the cost of an outlier."""
NODE = 0.5
"""Metres between places whose nearest is looked up."""
ROUNDS = 12
"""Of re-weighted least squares, at most."""
SETTLED = 1e-3
"""Metres by which a round must move the line to be followed by another."""
_AT = np.array([-np.sqrt(0.6), 0.0, np.sqrt(0.6)])  # Gauss-Legendre of three places
_WEIGHT = np.array([5.0, 8.0, 5.0]) / 9


@dataclass(frozen=True)
class Clothoids:
    """A line in the plane, chainage s from 0 to `length`; offsets t are to its left.

    Attributes:
        start: (2,) metres.
        heading: radians, at the start, from the x axis.
        knots: (K,) chainages, the first 0.
        curvature: (K,) 1/m at the knots, left turns positive; even in between.
    """

    start: F64
    heading: float
    knots: F64
    curvature: F64

    @property
    def length(self) -> float:
        """Metres."""
        return float(self.knots[-1])

    @cached_property
    def _turned(self) -> F64:
        """(K,) headings at the knots."""
        mean = (self.curvature[1:] + self.curvature[:-1]) / 2
        return np.concatenate([[self.heading], self.heading + np.cumsum(mean * np.diff(self.knots))])

    @cached_property
    def _nodes(self) -> tuple[F64, F64]:
        """Chainages (M,), among them all knots, and places (M, 2) there."""
        count = np.maximum(1, np.ceil(np.diff(self.knots) / NODE)).astype(int)
        ends = zip(self.knots[:-1].tolist(), self.knots[1:].tolist(), count.tolist(), strict=True)
        pieces = [np.linspace(a, b, n, endpoint=False) for a, b, n in ends]
        s = np.concatenate([*pieces, self.knots[-1:]])
        return s, self.start + np.concatenate([np.zeros((1, 2)), np.cumsum(self._chord(s[:-1], s[1:]), axis=0)])

    def _chord(self, a: F64, b: F64) -> F64:
        """(N, 2) from chainage a to b (N,), which lie close to each other."""
        heading = self.headings((a + b)[:, None] / 2 + (b - a)[:, None] / 2 * _AT)
        return np.stack([np.cos(heading) @ _WEIGHT, np.sin(heading) @ _WEIGHT], axis=-1) * ((b - a) / 2)[:, None]

    def headings(self, s: npt.ArrayLike) -> F64:
        """Radians at chainages (...); straight on beyond the ends."""
        s = np.asarray(s, np.float64)
        held = s.clip(0, self.length)
        i = np.searchsorted(self.knots, held, side="right").clip(1, len(self.knots) - 1) - 1
        along, step = held - self.knots[i], np.diff(self.knots)[i]
        rate = np.diff(self.curvature)[i] / step
        return np.asarray(self._turned[i] + along * (self.curvature[i] + rate * along / 2))

    def places(self, s: npt.ArrayLike, t: npt.ArrayLike = 0.0) -> F64:
        """(N, 2) at chainages (N,) and offsets (N,)."""
        s = np.asarray(s, np.float64)
        held, heading = s.clip(0, self.length), self.headings(s)
        nodes, places = self._nodes
        i = np.searchsorted(nodes, held, side="right").clip(1, len(nodes)) - 1
        forward, left = _directions(heading)
        beyond = (s - held)[:, None] * forward
        return np.asarray(places[i] + self._chord(nodes[i], held) + beyond + np.reshape(t, (-1, 1)) * left)

    def locate(self, xy: npt.ArrayLike) -> tuple[F64, F64]:
        """Chainages and offsets (N,) of places (N, 2), each by the part of the line that is nearest.

        What lies beyond an end has a chainage below 0, or above the length. From one node to the next the line is
        taken for an arc, which is right to a hundredth of a millimetre.
        """
        from scipy.spatial import cKDTree

        xy = np.asarray(xy, np.float64)[:, :2]
        nodes, places = self._nodes
        i = cKDTree(places).query(xy, workers=-1)[1]
        forward, left = (unit[i] for unit in _directions(self.headings(nodes)))
        away = xy - places[i]
        along, aside = (away * forward).sum(axis=1), (away * left).sum(axis=1)
        beyond = ((i == 0) & (along < 0)) | ((i == len(nodes) - 1) & (along > 0))
        bend = np.where(beyond, 0.0, np.interp(nodes, self.knots, self.curvature)[i])
        inwards = 1 - bend * aside
        turned = np.arctan2(bend * along, inwards)
        with np.errstate(divide="ignore", invalid="ignore"):
            s = np.where(np.abs(turned) > 1e-9, turned / bend, along / inwards)
        t = (2 * aside - bend * (along**2 + aside**2)) / (1 + np.hypot(bend * along, inwards))
        return nodes[i] + np.where(beyond, along, s), np.where(beyond, aside, t)

    def part(self, first: float, last: float) -> Clothoids:
        """The line from one chainage to another, which becomes its own chainage."""
        inner = self.knots[(self.knots > first + 0.1) & (self.knots < last - 0.1)]
        knots = np.concatenate([[first], inner, [last]])
        curvature = np.interp(knots, self.knots, self.curvature, left=0.0, right=0.0)
        return Clothoids(self.places([first])[0], float(self.headings(first)), knots - first, curvature)


def _directions(heading: F64) -> tuple[F64, F64]:
    """Unit vectors (N, 2) forward and to the left."""
    cos, sin = np.cos(heading), np.sin(heading)
    return np.stack([cos, sin], axis=-1), np.stack([-sin, cos], axis=-1)


def through(places: F64) -> Clothoids:
    """A rough chain along a polyline (N, 2): what `fit` begins with."""
    step = np.linalg.norm(np.diff(places, axis=0), axis=1)
    places = places[np.append(True, step > 1e-6)]
    chainage = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))])
    knots = np.linspace(0, chainage[-1], max(2, round(chainage[-1] / KNOT) + 1))
    corners = np.column_stack([np.interp(knots, chainage, column) for column in places.T])
    heading = np.unwrap(np.arctan2(*np.diff(corners, axis=0).T[::-1]))
    middle = (knots[1:] + knots[:-1]) / 2
    curvature = np.zeros(len(knots))
    if len(heading) > 1:
        curvature[1:-1] = np.diff(heading) / np.diff(middle)
    first = heading[0] - (curvature[0] + curvature[1]) / 4 * knots[1]
    return Clothoids(corners[0], float(first), knots, curvature)


def fit(line: Clothoids, places: F64, weights: F64 | None = None) -> Clothoids:
    """The chain nearest to places (N, 2), by least squares that outliers don't pull (Huber's weights).

    Args:
        line: to begin with; its length and knots stay.
        places: (N, 2) metres.
        weights: (N,) trust in each, 1 of what lies `NOISE` off the line; default: 1.
    """
    weights = np.ones(len(places)) if weights is None else weights
    for _ in range(ROUNDS):
        s, t = line.locate(places)
        robust = weights / np.maximum(1, np.abs(t) / max(NOISE, 2 * float(np.median(np.abs(t)))))
        effect = _effects(line, s.clip(0, line.length))
        step = np.diff(line.knots)
        smooth = np.zeros((len(step), effect.shape[1]))
        rows = np.arange(len(step))
        scale = 1 / (RATE * np.sqrt(KNOT * step))
        scale /= np.sqrt(np.maximum(1, np.abs(np.diff(line.curvature)) * scale))
        smooth[rows, rows + 2], smooth[rows, rows + 3] = -scale, scale
        left = effect.T @ (effect * robust[:, None]) / NOISE**2 + smooth.T @ smooth
        right = effect.T @ (robust * t) / NOISE**2 - smooth.T @ (scale * np.diff(line.curvature))
        change = np.linalg.solve(left + 1e-9 * np.eye(len(left)), right)
        start = line.places([0.0], [change[0]])[0]
        line = Clothoids(start, line.heading + float(change[1]), line.knots, line.curvature + change[2:])
        if np.abs(effect @ change).max(initial=0.0) < SETTLED:
            break
    return line


def _effects(line: Clothoids, s: F64) -> F64:
    """(N, K + 2) how far the line moves to its left at chainages (N,): by its start, heading, each curvature."""
    nodes = line._nodes[0]
    step = np.diff(nodes)[:, None]
    hats = np.column_stack([np.interp(nodes, line.knots, row) for row in np.eye(len(line.knots))])
    turn = np.column_stack([np.ones(len(nodes)), _integral(hats, step)])
    _, normal = _directions(line.headings(nodes))
    x, y = (_integral(turn * normal[:, [k]], step) for k in range(2))
    _, left = _directions(line.headings(s))
    i = np.searchsorted(nodes, s, side="right").clip(1, len(nodes) - 1) - 1
    share = ((s - nodes[i]) / np.diff(nodes)[i])[:, None]
    at_x, at_y = ((1 - share) * column[i] + share * column[i + 1] for column in (x, y))
    return np.column_stack([left @ normal[0], at_x * left[:, :1] + at_y * left[:, 1:]])


def _integral(values: F64, step: F64) -> F64:
    """(M, K) of values (M, K) from the first row on, by the trapezoidal rule."""
    area = (values[1:] + values[:-1]) / 2 * step
    return np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(area, axis=0)])
