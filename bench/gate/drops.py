"""Balls that a consumer's engine drops on a world's road and on the borders of tiles, and where they come to rest."""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.consumers import Fault
from bench.gate.places import Places
from scan2sim.pipeline.core.types import F64

BALL = 0.11
"""Radius in metres."""
FALL = 0.15
"""Metres that bodies fall."""
WITHIN = 0.02
"""Metres from the cloud's surface within which a body comes to rest."""
THROUGH = 0.3
"""Metres below it where a body has fallen through."""


def starts(places: Places) -> F64:
    """(N, 3) middles of balls before they fall."""
    return np.concatenate([places.road, places.borders]) + [0.0, 0.0, BALL + FALL]


def gaps(rests: F64, places: Places) -> F64:
    """(N,) metres between the lowest places of balls, their middles at `rests` (N, 3), and the cloud's surface."""
    rests = np.asarray(rests, np.float64).reshape(-1, 3)
    return rests[:, 2] - BALL - places.heights(rests[:, :2])


def told(off: F64) -> dict[str, Any]:
    """Figures of bodies that rest so far (N,) from the cloud's surface.

    Raises:
        Fault: one is too far from it, fell through, or left the places that points tell of.
    """
    figures = {
        "dropped": len(off),
        "drop_mean_m": round(float(np.nanmean(np.abs(off))), 4),
        "drop_max_m": round(float(np.nanmax(np.abs(off))), 4),
        "fell_through": int(np.sum(off < -THROUGH)),
    }
    if figures["fell_through"] or figures["drop_max_m"] > WITHIN or np.isnan(off).any():
        raise Fault(f"bodies don't come to rest on the cloud's surface: {np.round(off, 3).tolist()}", figures)
    return figures
