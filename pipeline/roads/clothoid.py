"""Clothoid chains (Euler spirals): curves with piecewise linear curvature, as used for the design of roads."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F64

KNOT_SPACING_M = 5.0
"""Approximate distance between knots, where the rate of curvature may change."""
POINT_SIGMA_M = 0.1
"""Standard deviation of points from the line."""
CURVATURE_RATE_SIGMA = 2e-4
"""Expected change of curvature along a road, 1/m2 (a clothoid of parameter A = 70 m); sharper corners are penalized
robustly."""
NODE_SPACING_M = 0.5
"""Spacing of the precomputed points in which the nearest one is searched."""
MAX_ROUNDS = 12
"""Maximum number of iterations of reweighted least squares."""
CONVERGED_M = 1e-3
"""The iteration stops when the line moves by less."""
_GAUSS_NODES = np.array([-np.sqrt(0.6), 0.0, np.sqrt(0.6)])  # Gauss-Legendre quadrature with three nodes
_GAUSS_WEIGHTS = np.array([5.0, 8.0, 5.0]) / 9


@dataclass(frozen=True)
class Clothoids:
    """A curve in the plane with chainage s from 0 to `length`; offsets t are positive to its left.

    Attributes:
        start: (2,) metres.
        heading: heading at the start, radians from the x axis.
        knots: (K,) chainages, the first is 0.
        curvature: (K,) curvature at the knots, 1/m, positive in left turns; linear in between.
    """

    start: F64
    heading: float
    knots: F64
    curvature: F64

    @property
    def length(self) -> float:
        """Length in metres."""
        return float(self.knots[-1])

    @cached_property
    def _knot_headings(self) -> F64:
        """Headings (K,) at the knots."""
        mean = (self.curvature[1:] + self.curvature[:-1]) / 2
        return np.concatenate([[self.heading], self.heading + np.cumsum(mean * np.diff(self.knots))])

    @cached_property
    def _nodes(self) -> tuple[F64, F64]:
        """Precomputed chainages (M,), including all knots, and points (M, 2) of the curve."""
        count = np.maximum(1, np.ceil(np.diff(self.knots) / NODE_SPACING_M)).astype(int)
        ends = zip(self.knots[:-1].tolist(), self.knots[1:].tolist(), count.tolist(), strict=True)
        pieces = [np.linspace(a, b, n, endpoint=False) for a, b, n in ends]
        s = np.concatenate([*pieces, self.knots[-1:]])
        return s, self.start + np.concatenate([np.zeros((1, 2)), np.cumsum(self._chord(s[:-1], s[1:]), axis=0)])

    def _chord(self, a: F64, b: F64) -> F64:
        """Vectors (N, 2) between chainages a and b (N,), which are close to each other."""
        heading = self.headings((a + b)[:, None] / 2 + (b - a)[:, None] / 2 * _GAUSS_NODES)
        return (
            np.stack([np.cos(heading) @ _GAUSS_WEIGHTS, np.sin(heading) @ _GAUSS_WEIGHTS], axis=-1)
            * ((b - a) / 2)[:, None]
        )

    def headings(self, s: npt.ArrayLike) -> F64:
        """Headings in radians at chainages (...); constant beyond the ends."""
        s = np.asarray(s, np.float64)
        clipped = s.clip(0, self.length)
        i = np.searchsorted(self.knots, clipped, side="right").clip(1, len(self.knots) - 1) - 1
        along, step = clipped - self.knots[i], np.diff(self.knots)[i]
        rate = np.diff(self.curvature)[i] / step
        return np.asarray(self._knot_headings[i] + along * (self.curvature[i] + rate * along / 2))

    def points(self, s: npt.ArrayLike, t: npt.ArrayLike = 0.0) -> F64:
        """Points (N, 2) at chainages (N,) and offsets (N,)."""
        s = np.asarray(s, np.float64)
        clipped, heading = s.clip(0, self.length), self.headings(s)
        nodes, points = self._nodes
        i = np.searchsorted(nodes, clipped, side="right").clip(1, len(nodes)) - 1
        forward, left = _directions(heading)
        beyond = (s - clipped)[:, None] * forward
        return np.asarray(points[i] + self._chord(nodes[i], clipped) + beyond + np.reshape(t, (-1, 1)) * left)

    def locate(self, xy: npt.ArrayLike) -> tuple[F64, F64]:
        """Chainages and offsets (N,) of points (N, 2), relative to the nearest part of the curve.

        Beyond the ends, chainages are below 0 or above the length. Between two nodes, the curve is approximated by an
        arc, with an error below 0.01 mm.
        """
        from scipy.spatial import cKDTree

        xy = np.asarray(xy, np.float64)[:, :2]
        nodes, points = self._nodes
        i = cKDTree(points).query(xy, workers=-1)[1]
        forward, left = (unit[i] for unit in _directions(self.headings(nodes)))
        offset_from_node = xy - points[i]
        along, aside = (offset_from_node * forward).sum(axis=1), (offset_from_node * left).sum(axis=1)
        beyond = ((i == 0) & (along < 0)) | ((i == len(nodes) - 1) & (along > 0))
        bend_at_node = np.where(beyond, 0.0, np.interp(nodes, self.knots, self.curvature)[i])
        inwards = 1 - bend_at_node * aside
        turn_angle = np.arctan2(bend_at_node * along, inwards)
        with np.errstate(divide="ignore", invalid="ignore"):
            s = np.where(np.abs(turn_angle) > 1e-9, turn_angle / bend_at_node, along / inwards)
        t = (2 * aside - bend_at_node * (along**2 + aside**2)) / (1 + np.hypot(bend_at_node * along, inwards))
        return nodes[i] + np.where(beyond, along, s), np.where(beyond, aside, t)

    def part(self, first: float, last: float) -> Clothoids:
        """The part of the curve between two chainages; its own chainage starts at 0."""
        inner = self.knots[(self.knots > first + 0.1) & (self.knots < last - 0.1)]
        knots = np.concatenate([[first], inner, [last]])
        curvature = np.interp(knots, self.knots, self.curvature, left=0.0, right=0.0)
        return Clothoids(self.points([first])[0], float(self.headings(first)), knots - first, curvature)


def _directions(heading: F64) -> tuple[F64, F64]:
    """Unit vectors (N, 2) forwards and to the left."""
    cos, sin = np.cos(heading), np.sin(heading)
    return np.stack([cos, sin], axis=-1), np.stack([-sin, cos], axis=-1)


def approximate(points: F64) -> Clothoids:
    """A rough chain along a polyline (N, 2), as initial value of `fit`."""
    step = np.linalg.norm(np.diff(points, axis=0), axis=1)
    points = points[np.append(True, step > 1e-6)]
    chainage = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    knots = np.linspace(0, chainage[-1], max(2, round(chainage[-1] / KNOT_SPACING_M) + 1))
    corners = np.column_stack([np.interp(knots, chainage, column) for column in points.T])
    heading = np.unwrap(np.arctan2(*np.diff(corners, axis=0).T[::-1]))
    middle = (knots[1:] + knots[:-1]) / 2
    curvature = np.zeros(len(knots))
    if len(heading) > 1:
        curvature[1:-1] = np.diff(heading) / np.diff(middle)
    first = heading[0] - (curvature[0] + curvature[1]) / 4 * knots[1]
    return Clothoids(corners[0], float(first), knots, curvature)


def fit(line: Clothoids, points: F64, weights: F64 | None = None) -> Clothoids:
    """Fit a chain to points (N, 2) by robust least squares (Huber weights).

    Args:
        line: initial curve; its length and knots are kept.
        points: (N, 2) metres.
        weights: (N,) weights of the points; default: 1, for a standard deviation of `POINT_SIGMA_M`.
    """
    weights = np.ones(len(points)) if weights is None else weights
    for _ in range(MAX_ROUNDS):
        s, t = line.locate(points)
        robust = weights / np.maximum(1, np.abs(t) / max(POINT_SIGMA_M, 2 * float(np.median(np.abs(t)))))
        jacobian = _jacobian(line, s.clip(0, line.length))
        step = np.diff(line.knots)
        smooth = np.zeros((len(step), jacobian.shape[1]))
        rows = np.arange(len(step))
        scale = 1 / (CURVATURE_RATE_SIGMA * np.sqrt(KNOT_SPACING_M * step))
        scale /= np.sqrt(np.maximum(1, np.abs(np.diff(line.curvature)) * scale))
        smooth[rows, rows + 2], smooth[rows, rows + 3] = -scale, scale
        left = jacobian.T @ (jacobian * robust[:, None]) / POINT_SIGMA_M**2 + smooth.T @ smooth
        right = jacobian.T @ (robust * t) / POINT_SIGMA_M**2 - smooth.T @ (scale * np.diff(line.curvature))
        change = np.linalg.solve(left + 1e-9 * np.eye(len(left)), right)
        start = line.points([0.0], [change[0]])[0]
        line = Clothoids(start, line.heading + float(change[1]), line.knots, line.curvature + change[2:])
        if np.abs(jacobian @ change).max(initial=0.0) < CONVERGED_M:
            break
    return line


def _jacobian(line: Clothoids, s: F64) -> F64:
    """Derivatives (N, K + 2) of the offset at chainages (N,) by the start, the heading, and the curvatures."""
    nodes = line._nodes[0]
    step = np.diff(nodes)[:, None]
    hats = np.column_stack([np.interp(nodes, line.knots, row) for row in np.eye(len(line.knots))])
    turn = np.column_stack([np.ones(len(nodes)), _integral(hats, step)])
    _, normal = _directions(line.headings(nodes))
    x, y = (_integral(turn * normal[:, [k]], step) for k in range(2))
    _, left = _directions(line.headings(s))
    i = np.searchsorted(nodes, s, side="right").clip(1, len(nodes) - 1) - 1
    fraction = ((s - nodes[i]) / np.diff(nodes)[i])[:, None]
    at_x, at_y = ((1 - fraction) * column[i] + fraction * column[i + 1] for column in (x, y))
    return np.column_stack([left @ normal[0], at_x * left[:, :1] + at_y * left[:, 1:]])


def _integral(values: F64, step: F64) -> F64:
    """Cumulative integral (M, K) of values (M, K) over the rows, by the trapezoidal rule."""
    area = (values[1:] + values[:-1]) / 2 * step
    return np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(area, axis=0)])
