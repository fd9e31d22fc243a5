"""Scale correction of visual odometry by GPS distances over sections long enough that GPS noise matters little.

The motions of the path are multiplied by a slowly changing factor, so that distances between its poses (relative
distance constraints) fit those of GPS. Directions and GPS positions aren't used (D3.2, section 4.1, uses distances
only).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from scan2sim.pipeline.core.types import F64, I64, Bools, GpsTrack

GPS_BIAS_M, GPS_BIAS_S = 1.5, 60.0
"""Slowly changing error of a receiver that reports no DOP, and the time in which its correlation decays to 1/e."""


class ScaleDrift(NamedTuple):
    """Drift of a camera's scale.

    Attributes:
        knot_m: metres between the knots of the scale factor.
        drift: standard deviation of the factor's logarithm from knot to knot.
        lengths_m: metres along the path between the poses whose distances are compared.
    """

    knot_m: float
    drift: float
    lengths_m: tuple[float, ...]


DRIFT_360 = ScaleDrift(50.0, 0.003, (50.0, 100.0, 200.0))
"""A 360 camera keeps seeing beside and behind it what it saw ahead, and hardly drifts."""
DRIFT_PERSPECTIVE = ScaleDrift(10.0, 0.05, (10.0, 20.0, 50.0, 100.0, 200.0))
"""In a turn, all known points leave a perspective camera's view; its scale then drifts by 6 % in ten metres (KITTI)."""


def factors(times: F64, positions: F64, unsure: Bools, gps: GpsTrack, drift: ScaleDrift = DRIFT_360) -> F64:
    """(T - 1,) scale factors of the motions between positions.

    Args:
        times: (T,) seconds.
        positions: (T, 3) positions of the camera.
        unsure: (T,) dead-reckoned poses; distances across them aren't used.
        gps: smoothed GPS track; its `sigma` is used if it has one.
        drift: drift of the camera's scale.
    """
    from scipy.optimize import least_squares

    steps = np.diff(positions, axis=0)
    travelled = np.concatenate([[0], np.cumsum(np.linalg.norm(steps, axis=1))])
    gps_positions = gps.at(times)
    knots = max(2, int(travelled[-1] / drift.knot_m) + 1)
    at = np.clip((travelled[:-1] + travelled[1:]) / 2 / max(travelled[-1], 1e-9) * (knots - 1), 0, knots - 1.000001)
    lower = at.astype(int)
    weight = at - lower
    ends = _pose_pairs(travelled, gps_positions, unsure, drift.lengths_m)
    if not len(ends):
        return np.ones(len(steps))
    gps_distance = np.linalg.norm(gps_positions[ends[:, 1]] - gps_positions[ends[:, 0]], axis=1)
    # displacement between two poses = sum over knots of factor * the knot's share of the path between them
    parts = np.zeros((knots, len(positions), 3))
    for shift, share in ((0, 1 - weight), (1, weight)):
        np.add.at(parts, (lower + shift, np.arange(1, len(positions))), share[:, None] * steps)
    parts = np.cumsum(parts, axis=1)
    between = parts[:, ends[:, 1]] - parts[:, ends[:, 0]]

    sigma = _sigma(times[ends[:, 1]] - times[ends[:, 0]], gps)

    def residual(log_factor: F64) -> F64:
        distance = np.linalg.norm(np.einsum("k,kcd->cd", np.exp(log_factor), between), axis=1)
        # overlapping constraints aren't independent
        density = np.sqrt(len(ends) / max(travelled[-1] / drift.knot_m, 1))
        return np.concatenate([(distance - gps_distance) / (sigma * density), np.diff(log_factor) / drift.drift])

    unscaled = np.linalg.norm(between.sum(axis=0), axis=1)
    start = np.full(knots, np.log(np.median(gps_distance / np.maximum(unscaled, 1e-9))))
    solved = least_squares(residual, start, loss="soft_l1")
    return np.exp((1 - weight) * solved.x[lower] + weight * solved.x[np.minimum(lower + 1, knots - 1)])


def _sigma(seconds: F64, gps: GpsTrack) -> F64:
    """(K,) standard deviation of GPS distances, metres, between fixes `seconds` (K,) apart: scatter, and slow error."""
    bias = GPS_BIAS_M if gps.sigma is None else float(np.median(gps.sigma))
    return np.sqrt(2 * gps.scatter**2 + 2 * bias**2 * (1 - np.exp(-seconds / GPS_BIAS_S)))


def _pose_pairs(travelled: F64, gps_positions: F64, unsure: Bools, lengths: tuple[float, ...]) -> I64:
    """(K, 2) pairs of poses at given distances along the path, every 5 m, known to GPS and tracked in between."""
    known = np.isfinite(gps_positions[:, 0])
    unsure_before = np.concatenate([[0], np.cumsum(unsure)])
    pairs = []
    starts = np.searchsorted(travelled, np.arange(0, travelled[-1], 5.0))
    for length in lengths:
        if length > travelled[-1]:
            length = travelled[-1]
        ends = np.searchsorted(travelled, travelled[starts] + length)
        for i, j in zip(starts, ends, strict=True):
            if j < len(travelled) and known[i] and known[j] and unsure_before[j] == unsure_before[i]:
                pairs.append((i, j))
    return np.unique(np.array(pairs, np.int64).reshape(-1, 2), axis=0)


def apply(positions: F64, factor: F64) -> F64:
    """(T, 3) positions after multiplying the motions between them by factors (T - 1,)."""
    steps = np.diff(positions, axis=0) * factor[:, None]
    return positions[0] + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
