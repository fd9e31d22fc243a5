"""Phantom returns of a simulated scanner: surface in the world where the recorded ray passed on.

A recorded ray passed a surface if its return is far behind it, or if it has none. A ray without a return that hits the
ground, or surface that its ring has on both sides of the gap, isn't evidence of free space: glass, wet or dark surface
and the scanner's own vehicle swallow rays, too. Such hits are counted, but not as phantoms.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F32
from scan2sim.pipeline.lidar.casting import Simulated
from scan2sim.pipeline.lidar.range_errors import BAND_NAMES, FAR_EARLY_M, distance_band, share
from scan2sim.pipeline.lidar.unreturned import UnreturnedRays

GROUND = "terrain"
SAME_SURFACE_RATIO = 0.1
"""Returns on both sides of a gap belong to the surface hit in it if their ranges differ from its range by less than
this share of it, or by less than `FAR_EARLY_M`."""
Row = dict[str, Any]


def row(
    returned: Simulated,
    unreturned: UnreturnedRays,
    distance: F32,
    surface: npt.NDArray[np.int16],
    names: Sequence[str],
    max_range: float,
    reason: str = "",
) -> Row:
    """Measures of phantom returns; None if there is none to measure.

    Args:
        returned: the rays with a return.
        unreturned: (M,) the rays without one.
        distance, surface: (M,) range and surface that each of these hits, see `Scanner.cast`.
        names: of the surfaces.
        max_range: range in metres up to which the scanner has returns; hits beyond it don't count.
        reason: why rays without a return are unknown, or "".

    Returns:
        `rays`: number of rays without a return. `ground`, `surface`: shares of them that hit the ground, or surface
        with returns on both sides of the gap. `without_return`: share of the simulated returns that are phantoms
        because the recorded ray had none; `by_surface` and `by_distance` (of the hit): the same. `phantom`: with those
        whose recorded return is more than `FAR_EARLY_M` behind. `reason`.
    """
    early = (returned.surface >= 0) & (returned.range < returned.recorded - FAR_EARLY_M)
    hit = (surface >= 0) & (distance < max_range)
    ground = hit & (surface == (list(names).index(GROUND) if GROUND in names else -2))
    near = np.where(hit, distance, 0)
    apart = np.abs(unreturned.beside - near[:, None]).max(axis=1)
    same = hit & ~ground & (apart < np.maximum(FAR_EARLY_M, SAME_SURFACE_RATIO * near))
    phantom = hit & ~ground & ~same
    simulated = np.concatenate([returned.surface[returned.surface >= 0], surface[hit]])
    band = distance_band(np.concatenate([returned.range[returned.surface >= 0], distance[hit]]))
    where = np.concatenate([np.zeros((returned.surface >= 0).sum(), bool), phantom[hit]])
    known = len(unreturned) > 0
    return {
        "rays": len(unreturned),
        "ground": share(ground) if known else None,
        "surface": share(same) if known else None,
        "without_return": share(where) if known else None,
        "phantom": round(float(phantom.sum() + early.sum()) / len(simulated), 4) if known and len(simulated) else None,
        "by_surface": {name: share(where[simulated == i]) if known else None for i, name in enumerate(names)},
        "by_distance": {name: share(where[band == i]) if known else None for i, name in enumerate(BAND_NAMES)},
        "reason": reason,
    }
