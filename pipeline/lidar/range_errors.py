"""Range errors of simulated sweeps: by the surface that was hit, and by the recorded distance."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import Bools
from scan2sim.pipeline.lidar.casting import Simulated

EARLY_M, FAR_EARLY_M = 0.2, 0.5
"""A simulated return is too early if it is nearer than the recorded one by this; for vegetation, by the second."""
SURFACE_RADIUS_M = 0.05**0.5
"""Distance within which a return has a surface: 22 cm, the threshold of the literature's F-score (.05 m2)."""
BANDS_M = (0.0, 10.0, 20.0, 40.0, 80.0)
BAND_NAMES = tuple(f"{low:.0f}-{high:.0f} m" for low, high in pairwise(BANDS_M))
"""Names of the bands of recorded range, in order."""
MAX_RANGE_M = BANDS_M[-1]
"""Farthest recorded return that is compared."""
Row = dict[str, Any]


def row(rays: Simulated) -> Row:
    """Measures over rays; None if there is none to measure.

    Returns:
        rays: their number. Over those that hit a surface: `median_m` and `p90_m`, percentiles of the absolute range
        error; `early_20cm` and `early_50cm`, shares that end too early by more than that; `late_50cm`. Over all of
        them: `missing`, the share that hits nothing, and `near_surface`, the share of recorded returns within
        `SURFACE_RADIUS_M` of a surface in any direction.
    """
    hit = rays.surface >= 0
    error = rays.range[hit].astype(np.float64) - rays.recorded[hit]
    return {
        "rays": len(hit),
        "median_m": _percentile(np.abs(error), 50),
        "p90_m": _percentile(np.abs(error), 90),
        "early_20cm": share(error < -EARLY_M),
        "early_50cm": share(error < -FAR_EARLY_M),
        "late_50cm": share(error > FAR_EARLY_M),
        "missing": share(~hit),
        "near_surface": share(rays.apart < SURFACE_RADIUS_M),
    }


def by_surface(rays: Simulated, names: Sequence[str], recorded_on: npt.NDArray[np.integer]) -> dict[str, Row]:
    """`row` of the rays that hit each surface, by its name.

    Which class a return was recorded on isn't known to a lidar, but which surface it hits in the world is: errors are
    charged to that surface. A ray without a hit is charged to the class that the return was recorded on: `missing` and
    `near_surface` are shares of the returns that were recorded on the surface.

    Args:
        rays: of all sweeps.
        names: of the surfaces.
        recorded_on: (N,) index of the surface that each return was recorded on, -1 if unknown.
    """
    found: dict[str, Row] = {}
    for i, name in enumerate(names):
        hit, recorded = row(rays.take(rays.surface == i)), row(rays.take(np.asarray(recorded_on == i)))
        found[name] = hit | {key: recorded[key] for key in ("missing", "near_surface")}
    return found


def by_distance(rays: Simulated) -> dict[str, Row]:
    """`row` of the rays of each band of recorded range, by its name."""
    band = distance_band(rays.recorded)
    return {name: row(rays.take(band == i)) for i, name in enumerate(BAND_NAMES)}


def distance_band(ranges: npt.NDArray[np.floating]) -> npt.NDArray[np.integer]:
    """(N,) index in `BAND_NAMES` of ranges (N,) in metres; farther ones are `len(BAND_NAMES)`."""
    return np.digitize(ranges, BANDS_M) - 1


def _percentile(values: npt.NDArray[np.floating], percent: float) -> float | None:
    return round(float(np.percentile(values, percent)), 4) if len(values) else None


def share(chosen: Bools) -> float | None:
    """Share of True; None of no values."""
    return round(float(chosen.mean()), 4) if len(chosen) else None
