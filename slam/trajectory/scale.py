"""Scale: a camera alone drifts in it; distances along GPS tie it, in stretches so long that GPS's noise matters little.

The path's steps are multiplied by a factor that changes slowly, so that the path's chords fit GPS's. Directions stay
the camera's own: where GPS is, nobody asks (D3.2, section 4.1, uses distances alone).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from scan2sim.pipeline.core.types import F64, I64, Bools, GpsTrack

SLOW, MEMORY = 1.5, 60.0
"""Metres by which a receiver that tells no DOP is off, and seconds after which that has decayed to 1/e."""


class Drifting(NamedTuple):
    """How a camera's scale drifts.

    Attributes:
        knot: metres between the places where the factor may change.
        drift: how much it may change between them.
        chords: metres, of those compared.
    """

    knot: float
    drift: float
    chords: tuple[float, ...]


AROUND = Drifting(50.0, 0.003, (50.0, 100.0, 200.0))
"""A 360 camera: it sees aside and behind what it saw ahead, and hardly drifts."""
AHEAD = Drifting(10.0, 0.05, (10.0, 20.0, 50.0, 100.0, 200.0))
"""A perspective camera: in a turn all that it knows leaves its view; by 6 % in ten metres there (KITTI)."""


def factors(times: F64, positions: F64, unsure: Bools, gps: GpsTrack, drifting: Drifting = AROUND) -> F64:
    """(T - 1,) what the steps between (T, 3) positions at (T,) times are to be multiplied by.

    Args:
        times: seconds.
        positions: of the camera.
        unsure: (T,) where the camera saw nothing: chords over such stretches tell nothing.
        gps: the track, smoothed; its own `sigma` is believed.
        drifting: how the camera's scale does.
    """
    from scipy.optimize import least_squares

    steps = np.diff(positions, axis=0)
    travelled = np.concatenate([[0], np.cumsum(np.linalg.norm(steps, axis=1))])
    there = gps.at(times)
    knots = max(2, int(travelled[-1] / drifting.knot) + 1)
    place = np.clip((travelled[:-1] + travelled[1:]) / 2 / max(travelled[-1], 1e-9) * (knots - 1), 0, knots - 1.000001)
    lower = place.astype(int)
    weight = place - lower
    ends = _chords(travelled, there, unsure, drifting.chords)
    if not len(ends):
        return np.ones(len(steps))
    far = np.linalg.norm(there[ends[:, 1]] - there[ends[:, 0]], axis=1)
    # chord = sum over knots of factor * what of the path belongs to the knot
    parts = np.zeros((knots, len(positions), 3))
    for shift, share in ((0, 1 - weight), (1, weight)):
        np.add.at(parts, (lower + shift, np.arange(1, len(positions))), share[:, None] * steps)
    parts = np.cumsum(parts, axis=1)
    between = parts[:, ends[:, 1]] - parts[:, ends[:, 0]]

    sigma = _sigma(times[ends[:, 1]] - times[ends[:, 0]], gps)

    def residual(log_factor: F64) -> F64:
        chord = np.linalg.norm(np.einsum("k,kcd->cd", np.exp(log_factor), between), axis=1)
        density = np.sqrt(len(ends) / max(travelled[-1] / drifting.knot, 1))  # chords that overlap aren't independent
        return np.concatenate([(chord - far) / (sigma * density), np.diff(log_factor) / drifting.drift])

    whole = np.linalg.norm(between.sum(axis=0), axis=1)
    start = np.full(knots, np.log(np.median(far / np.maximum(whole, 1e-9))))
    solved = least_squares(residual, start, loss="soft_l1")
    return np.exp((1 - weight) * solved.x[lower] + weight * solved.x[np.minimum(lower + 1, knots - 1)])


def _sigma(seconds: F64, gps: GpsTrack) -> F64:
    """(K,) metres by which chords of so many seconds (K,) are off: by fixes' scatter, and by what wanders meanwhile."""
    slow = SLOW if gps.sigma is None else float(np.median(gps.sigma))
    return np.sqrt(2 * gps.scatter**2 + 2 * slow**2 * (1 - np.exp(-seconds / MEMORY)))


def _chords(travelled: F64, there: F64, unsure: Bools, lengths: tuple[float, ...]) -> I64:
    """(K, 2) pairs of poses that GPS and camera both know, some way apart."""
    known = np.isfinite(there[:, 0])
    doubtful = np.concatenate([[0], np.cumsum(unsure)])
    pairs = []
    marks = np.searchsorted(travelled, np.arange(0, travelled[-1], 5.0))
    for length in lengths:
        if length > travelled[-1]:
            length = travelled[-1]
        ends = np.searchsorted(travelled, travelled[marks] + length)
        for i, j in zip(marks, ends, strict=True):
            if j < len(travelled) and known[i] and known[j] and doubtful[j] == doubtful[i]:
                pairs.append((i, j))
    return np.unique(np.array(pairs, np.int64).reshape(-1, 2), axis=0)


def apply(positions: F64, factor: F64) -> F64:
    """(T, 3) positions whose steps have been multiplied by (T - 1,) factors."""
    steps = np.diff(positions, axis=0) * factor[:, None]
    return positions[0] + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
