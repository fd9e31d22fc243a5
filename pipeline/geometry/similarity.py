"""Similarities (rotation, scale, shift) between two sets of places: by least squares, and in spite of wrong ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.types import F64, Bools

TRIALS = 1000


@dataclass(frozen=True)
class Similarity:
    """`scale * rotation @ x + translation` in D dimensions: (D, D) rotation, (D,) translation."""

    scale: float
    rotation: F64
    translation: F64

    def apply(self, points: F64) -> F64:
        """(N, D) moved points."""
        return self.scale * points @ self.rotation.T + self.translation


def umeyama(source: F64, target: F64, *, scaled: bool) -> Similarity:
    """The similarity (or rigid motion) that brings (N, D) `source` nearest to `target`, least squares, no reflection.

    Source: Umeyama, Least-squares estimation of transformation parameters between two point patterns, 1991.

    Raises:
        DataError: all points of one of them are one.
    """
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    spread = float((a * a).sum())
    if spread < 1e-12 or (b * b).sum() < 1e-12:
        raise DataError("trajectory", "doesn't move", "Take a part in which the camera travels")
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.ones(len(s))
    sign[-1] = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    rotation = (u * sign) @ vt
    scale = float(s @ sign) / spread if scaled else 1.0
    return Similarity(scale, rotation, target.mean(axis=0) - scale * rotation @ source.mean(axis=0))


def robust(source: F64, target: F64, reach: float, seed: int = 0) -> tuple[Similarity, Bools]:
    """The similarity of (N, 3) `source` to `target`, and which (N,) pairs it brings within `reach` of each other.

    Three pairs at a time are tried (all of them where that is less than `TRIALS`); the best trial's pairs, by truncated
    squares, are fitted again until they stay the same.
    Source: Fischler and Bolles, Random sample consensus, 1981; Torr and Zisserman, MLESAC, 2000 (its MSAC).

    Raises:
        DataError: fewer than three pairs, or no three that agree.
    """
    if len(source) < 3:
        raise DataError("places", f"only {len(source)} of them", "Three are the least from which a similarity follows")
    random = np.random.default_rng(seed)
    best, cost = None, np.inf
    for _ in range(TRIALS):
        three = random.choice(len(source), 3, replace=False)
        try:
            trial = umeyama(source[three], target[three], scaled=True)
        except DataError:
            continue
        error = np.minimum(((trial.apply(source) - target) ** 2).sum(axis=1), reach**2).sum()
        if error < cost and trial.scale > 0:
            best, cost = trial, error
    if best is None:
        raise DataError("places", "are all one", "Take photos from different places")
    near = _near(best, source, target, reach)
    for _ in range(20):
        if near.sum() < 3:
            raise DataError("places", "no three of them agree", "See whether photos and positions belong together")
        best = umeyama(source[near], target[near], scaled=True)
        again = _near(best, source, target, reach)
        if (again == near).all():
            break
        near = again
    return best, near


def _near(similarity: Similarity, source: F64, target: F64, reach: float) -> Bools:
    return np.asarray(np.linalg.norm(similarity.apply(source) - target, axis=1) < reach)
