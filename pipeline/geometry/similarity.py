"""Similarity transforms (rotation, scale, translation) between two point sets: least squares, and robust (RANSAC)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.types import F64, Bools

RANSAC_TRIALS = 1000


@dataclass(frozen=True)
class Similarity:
    """`scale * rotation @ x + translation` in D dimensions: (D, D) rotation, (D,) translation."""

    scale: float
    rotation: F64
    translation: F64

    def apply(self, points: F64) -> F64:
        """Transformed points (N, D)."""
        return self.scale * points @ self.rotation.T + self.translation


def umeyama(source: F64, target: F64, *, scaled: bool) -> Similarity:
    """Similarity (or rigid transform) of (N, D) `source` to `target` by least squares, without reflection.

    Source: Umeyama, Least-squares estimation of transformation parameters between two point patterns, 1991.

    Raises:
        DataError: all points of `source` or of `target` coincide.
    """
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    spread = float((a * a).sum())
    if spread < 1e-12 or (b * b).sum() < 1e-12:
        raise DataError("trajectory", "doesn't move", "Use a part in which the camera moves")
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.ones(len(s))
    sign[-1] = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    rotation = (u * sign) @ vt
    scale = float(s @ sign) / spread if scaled else 1.0
    return Similarity(scale, rotation, target.mean(axis=0) - scale * rotation @ source.mean(axis=0))


def fit_robust(source: F64, target: F64, max_distance: float, seed: int = 0) -> tuple[Similarity, Bools]:
    """Robust similarity of (N, 3) `source` to `target`, and (N,) bool, True for inliers within `max_distance`.

    `RANSAC_TRIALS` samples of three pairs are scored by truncated squared distances; the best one is refined on its
    inliers until they don't change.
    Source: Fischler and Bolles, Random sample consensus, 1981; Torr and Zisserman, MLESAC, 2000 (its MSAC).

    Raises:
        DataError: fewer than three pairs, or no three that agree.
    """
    if len(source) < 3:
        raise DataError(
            "positions", f"only {len(source)} given", "Give at least three: a similarity needs three points"
        )
    random = np.random.default_rng(seed)
    best, cost = None, np.inf
    for _ in range(RANSAC_TRIALS):
        sample = random.choice(len(source), 3, replace=False)
        try:
            trial = umeyama(source[sample], target[sample], scaled=True)
        except DataError:
            continue
        error = np.minimum(((trial.apply(source) - target) ** 2).sum(axis=1), max_distance**2).sum()
        if error < cost and trial.scale > 0:
            best, cost = trial, error
    if best is None:
        raise DataError("positions", "all coincide", "Take photos from different positions")
    inliers = _inliers(best, source, target, max_distance)
    for _ in range(20):
        if inliers.sum() < 3:
            raise DataError("positions", "no three of them agree", "Check that the positions belong to these photos")
        best = umeyama(source[inliers], target[inliers], scaled=True)
        updated = _inliers(best, source, target, max_distance)
        if (updated == inliers).all():
            break
        inliers = updated
    return best, inliers


def _inliers(similarity: Similarity, source: F64, target: F64, max_distance: float) -> Bools:
    return np.asarray(np.linalg.norm(similarity.apply(source) - target, axis=1) < max_distance)
