"""A consumer GPS receiver: positions that wander by metres, slowly."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scan2sim.pipeline.core.types import F64, Trajectory

ORIGIN = (49.2, 16.6, 230.0)  # latitude, longitude (degrees, WGS 84), altitude of the world's origin
WANDER = (1.5, 1.5, 2.5)  # metres, standard deviation of the correlated error: east, north, up
MEMORY = 60.0  # seconds after which it has decayed to 1/e
JITTER = 0.15  # metres, white


def receiver(
    trajectory: Trajectory,
    rate: float = 1.0,
    seed: int = 0,
    *,
    gaps: Sequence[tuple[float, float]] = (),
    jumps: Sequence[tuple[float, float]] = (),
) -> tuple[F64, F64]:
    """Times (K,) and positions (K, 3), local metres, that a receiver reports along a trajectory.

    Args:
        rate: fixes a second.
        gaps: (from, to) seconds without a fix.
        jumps: (time, metres): from then on the position is off by so much in some horizontal direction, until the
            next one (multipath); (time, 0) ends it.
    """
    rng = np.random.default_rng([seed, 13])
    start, end = float(trajectory.times[0]), float(trajectory.times[-1])
    times = start + np.arange(int(np.floor((end - start) * rate + 1e-9)) + 1) / rate
    keep = np.exp(-1 / (rate * MEMORY))
    error = rng.normal(size=(len(times), 3)) * WANDER
    for i in range(1, len(error)):  # Gauss-Markov
        error[i] = keep * error[i - 1] + np.sqrt(1 - keep**2) * error[i]
    error += rng.normal(0, JITTER, error.shape)
    angle = rng.uniform(0, 2 * np.pi, len(jumps))
    shift = np.zeros((len(times), 2))
    for (since, far), a in sorted(zip(jumps, angle, strict=True)):
        shift[times >= since] = far * np.array([np.cos(a), np.sin(a)])
    error[:, :2] += shift
    seen = np.ones(len(times), bool)
    for since, until in gaps:
        seen &= (times < since) | (times >= until)
    return times[seen], (trajectory.at(times) + error)[seen]


def geographic(positions: F64, origin: tuple[float, float, float] = ORIGIN) -> F64:
    """(K, 3) latitude, longitude (degrees), altitude (metres) of local east, north, up metres (K, 3).

    Local axes are those of a topocentric frame at `origin`.
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
