"""What changes along a road, as piecewise cubics: heights, offsets of lines (P-splines, Eilers and Marx 1996)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F64

ROUNDS = 12
COARSE = 16.0
"""Times the noise: what is taken for noise in the beginning, so that the curve is stiff before it is exact."""


@dataclass(frozen=True)
class Profile:
    """A smooth function of the chainage: cubics that meet.

    Attributes:
        knots: (K + 1,) chainages.
        cubics: (4, K) coefficients of each piece from its first knot on, the constant first: a, b, c, d of OpenDRIVE.
    """

    knots: F64
    cubics: F64

    @classmethod
    def constant(cls, knots: F64, value: float) -> Profile:
        """The same value everywhere."""
        return cls(knots, np.outer([value, 0.0, 0.0, 0.0], np.ones(len(knots) - 1)))

    def at(self, s: npt.ArrayLike) -> F64:
        """Values at chainages (...); the outermost pieces go on beyond the ends."""
        s = np.asarray(s, np.float64)
        i = np.searchsorted(self.knots, s, side="right").clip(1, len(self.knots) - 1) - 1
        a, b, c, d = self.cubics[:, i]
        x = s - self.knots[i]
        return np.asarray(a + x * (b + x * (c + x * d)))

    def pieces(self, first: float, last: float) -> list[tuple[float, F64]]:
        """What holds from one chainage to another: where each cubic begins, and its (4,) coefficients from there on."""
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
    """The smooth curve nearest to values (N,) at chainages (N,), whatever a minority of them says.

    Weights are Cauchy's, first for large deviations, then for such as the noise.

    Args:
        knots: (K + 1,) evenly spaced chainages, where pieces are to meet.
        s, values: (N,) what was measured, at least one.
        noise: how far off values are.
        bend: by how much the curve is expected to leave a straight line between two knots.
    """
    return fit_sum(knots, s, np.ones((len(s), 1)), values, noise, [bend])[0]


def fit_sum(knots: F64, s: F64, factors: F64, values: F64, noise: float, bends: Sequence[float]) -> list[Profile]:
    """Several curves at once: values are their sum, each times its factor (N, C); else as `fit`.

    Raises:
        ValueError: there are no values: nothing determines a curve.
    """
    from scipy.interpolate import BSpline, PPoly

    if not len(values):
        raise ValueError("a profile needs at least one value")
    step = knots[1] - knots[0]
    padded = np.concatenate([knots[0] - step * np.arange(3, 0, -1), knots, knots[-1] + step * np.arange(1, 4)])
    basis = BSpline.design_matrix(s.clip(knots[0], knots[-1]), padded, 3).toarray()
    count = basis.shape[1]
    whole = np.hstack([basis * factor[:, None] for factor in factors.T])
    smooth = 1e-9 * np.eye(whole.shape[1])
    for i, bend in enumerate(bends):
        second = np.diff(np.eye(count), 2, axis=0) / bend
        own = slice(i * count, (i + 1) * count)
        smooth[own, own] += second.T @ second
    found = np.zeros(whole.shape[1])
    found[:count] = np.median(values)
    for scale in noise * np.maximum(1, COARSE / 2.0 ** np.arange(-1, ROUNDS)):
        weight = 1 / (1 + ((values - whole @ found) / scale) ** 2) / scale**2
        found = np.linalg.solve(whole.T @ (whole * weight[:, None]) + smooth, whole.T @ (weight * values))
    pieces = [PPoly.from_spline(BSpline(padded, part, 3)).c[::-1, 3:-3] for part in np.split(found, len(bends))]
    return [Profile(knots, np.asarray(piece, np.float64)) for piece in pieces]
