"""Profiles along a road (heights, offsets of lines) as piecewise cubics (P-splines, Eilers and Marx 1996)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F64

REWEIGHTING_ROUNDS = 12
INITIAL_NOISE_FACTOR = 16.0
"""Initial scale of the robust loss relative to the noise: the fit starts stiff and is refined (graduated)."""


@dataclass(frozen=True)
class Profile:
    """A smooth function of the chainage: a cubic spline.

    Attributes:
        knots: (K + 1,) chainages.
        cubics: (4, K) coefficients of each piece relative to its first knot, constant first: a, b, c, d of OpenDRIVE.
    """

    knots: F64
    cubics: F64

    @classmethod
    def constant(cls, knots: F64, value: float) -> Profile:
        """A constant profile."""
        return cls(knots, np.outer([value, 0.0, 0.0, 0.0], np.ones(len(knots) - 1)))

    def at(self, s: npt.ArrayLike) -> F64:
        """Values at chainages (...); the outermost pieces are extrapolated beyond the ends."""
        s = np.asarray(s, np.float64)
        i = np.searchsorted(self.knots, s, side="right").clip(1, len(self.knots) - 1) - 1
        a, b, c, d = self.cubics[:, i]
        x = s - self.knots[i]
        return np.asarray(a + x * (b + x * (c + x * d)))

    def pieces(self, first: float, last: float) -> list[tuple[float, F64]]:
        """Cubics between two chainages: the start of each, and its coefficients (4,) relative to that start."""
        begins = [first, *(k for k in self.knots[1:-1].tolist() if first + 1e-6 < k < last - 1e-6)]
        found = []
        for begin in begins:
            i = int(np.searchsorted(self.knots, begin + 1e-9, side="right").clip(1, len(self.knots) - 1)) - 1
            a, b, c, d = self.cubics[:, i]
            x = begin - self.knots[i]
            moved = [a + x * (b + x * (c + x * d)), b + x * (2 * c + 3 * d * x), c + 3 * d * x, d]
            found.append((begin, np.array(moved)))
        return found

    def __sub__(self, other: Profile) -> Profile:
        return Profile(self.knots, self.cubics - other.cubics)


def fit(knots: F64, s: F64, values: F64, noise: float, bend: float) -> Profile:
    """Robustly fit a smooth curve to values (N,) at chainages (N,).

    Iteratively reweighted with the Cauchy loss, whose scale decreases to the noise.

    Args:
        knots: (K + 1,) evenly spaced chainages of the knots.
        s, values: (N,) measurements, at least one.
        noise: standard deviation of the measurements.
        bend: expected deviation of the curve from a straight line between two knots.
    """
    return fit_sum(knots, s, np.ones((len(s), 1)), values, noise, [bend])[0]


def fit_sum(knots: F64, s: F64, factors: F64, values: F64, noise: float, bends: Sequence[float]) -> list[Profile]:
    """Fit several curves at once: values are the sum of the curves times their factors (N, C); otherwise as `fit`.

    Raises:
        ValueError: there are no values.
    """
    from scipy.interpolate import BSpline, PPoly

    if not len(values):
        raise ValueError("a profile needs at least one value")
    step = knots[1] - knots[0]
    padded = np.concatenate([knots[0] - step * np.arange(3, 0, -1), knots, knots[-1] + step * np.arange(1, 4)])
    basis = BSpline.design_matrix(s.clip(knots[0], knots[-1]), padded, 3).toarray()
    count = basis.shape[1]
    design = np.hstack([basis * factor[:, None] for factor in factors.T])
    smooth = 1e-9 * np.eye(design.shape[1])
    for i, bend in enumerate(bends):
        second = np.diff(np.eye(count), 2, axis=0) / bend
        own = slice(i * count, (i + 1) * count)
        smooth[own, own] += second.T @ second
    found = np.zeros(design.shape[1])
    found[:count] = np.median(values)
    for scale in noise * np.maximum(1, INITIAL_NOISE_FACTOR / 2.0 ** np.arange(-1, REWEIGHTING_ROUNDS)):
        weight = 1 / (1 + ((values - design @ found) / scale) ** 2) / scale**2
        found = np.linalg.solve(design.T @ (design * weight[:, None]) + smooth, design.T @ (weight * values))
    pieces = [PPoly.from_spline(BSpline(padded, part, 3)).c[::-1, 3:-3] for part in np.split(found, len(bends))]
    return [Profile(knots, np.asarray(piece, np.float64)) for piece in pieces]
