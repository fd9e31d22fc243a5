"""Simulated consumer GPS receiver, with a slowly changing error of metres."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scan2sim.pipeline.core.types import F64, Trajectory

ORIGIN = (49.2, 16.6, 230.0)  # latitude, longitude (degrees, WGS 84), altitude of the world's origin
BIAS_SIGMA_M = (1.5, 1.5, 2.5)  # standard deviation of the slowly changing error: east, north, up
BIAS_TIME_S = 60.0  # correlation time of that error
NOISE_SIGMA_M = 0.15  # standard deviation of the white noise


def receiver(
    trajectory: Trajectory,
    rate: float = 1.0,
    seed: int = 0,
    *,
    gaps: Sequence[tuple[float, float]] = (),
    jumps: Sequence[tuple[float, float]] = (),
) -> tuple[F64, F64]:
    """Fixes of a receiver along a trajectory: times (K,) and positions (K, 3) in local metres.

    Args:
        trajectory: true trajectory.
        rate: fixes per second.
        seed: seed of the errors.
        gaps: (from, to) seconds without fixes.
        jumps: (time, metres): from this time to the next jump, positions are offset by this distance in a random
            horizontal direction (multipath); (time, 0) ends it.
    """
    rng = np.random.default_rng([seed, 13])
    start, end = float(trajectory.times[0]), float(trajectory.times[-1])
    times = start + np.arange(int(np.floor((end - start) * rate + 1e-9)) + 1) / rate
    decay = np.exp(-1 / (rate * BIAS_TIME_S))
    error = rng.normal(size=(len(times), 3)) * BIAS_SIGMA_M
    for i in range(1, len(error)):  # Gauss-Markov process
        error[i] = decay * error[i - 1] + np.sqrt(1 - decay**2) * error[i]
    error += rng.normal(0, NOISE_SIGMA_M, error.shape)
    angle = rng.uniform(0, 2 * np.pi, len(jumps))
    shift = np.zeros((len(times), 2))
    for (since, distance), a in sorted(zip(jumps, angle, strict=True)):
        shift[times >= since] = distance * np.array([np.cos(a), np.sin(a)])
    error[:, :2] += shift
    available = np.ones(len(times), bool)
    for since, until in gaps:
        available &= (times < since) | (times >= until)
    return times[available], (trajectory.at(times) + error)[available]


def geographic(positions: F64, origin: tuple[float, float, float] = ORIGIN) -> F64:
    """(K, 3) latitude, longitude (degrees) and altitude (metres) of local positions (K, 3) in metres.

    Local axes (east, north, up) are those of a topocentric frame at `origin`.
    """
    from pyproj import Transformer

    latitude, longitude, altitude = origin
    chain = (
        f"+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lon_0={longitude} +lat_0={latitude} "
        f"+h_0={altitude} +step +inv +proj=cart +ellps=WGS84 +step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )
    x, y, z = np.asarray(positions, np.float64).T
    lon, lat, up = Transformer.from_pipeline(chain).transform(x, y, z)
    return np.column_stack([lat, lon, up])
