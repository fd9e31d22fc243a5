"""Balls dropped by a consumer's physics engine on the road and on tile borders, and where they come to rest."""

from __future__ import annotations

from typing import Any

import numpy as np

from scan2sim.pipeline.core.types import F64
from tests.fakes.world_checks import Fault
from tests.fakes.world_checks.reference import WorldReference

BALL_RADIUS_M = 0.11
DROP_HEIGHT_M = 0.15
MAX_REST_GAP_M = 0.02
"""Maximum distance from the cloud's surface of a body at rest."""
FALL_THROUGH_M = 0.3
"""Depth below the surface at which a body counts as fallen through."""


def start_positions(reference: WorldReference) -> F64:
    """(N, 3) centres of the balls before they fall."""
    return np.concatenate([reference.road, reference.borders]) + [0.0, 0.0, BALL_RADIUS_M + DROP_HEIGHT_M]


def rest_gaps(rests: F64, reference: WorldReference) -> F64:
    """(N,) gaps in metres between balls with centres `rests` (N, 3) and the cloud's surface."""
    rests = np.asarray(rests, np.float64).reshape(-1, 3)
    return rests[:, 2] - BALL_RADIUS_M - reference.heights(rests[:, :2])


def rest_metrics(off: F64) -> dict[str, Any]:
    """Metrics of bodies that rest at distances (N,) from the cloud's surface.

    Raises:
        Fault: a body is too far from the surface, fell through, or left the area covered by points.
    """
    metrics = {
        "dropped": len(off),
        "drop_mean_m": round(float(np.nanmean(np.abs(off))), 4),
        "drop_max_m": round(float(np.nanmax(np.abs(off))), 4),
        "fell_through": int(np.sum(off < -FALL_THROUGH_M)),
    }
    if metrics["fell_through"] or metrics["drop_max_m"] > MAX_REST_GAP_M or np.isnan(off).any():
        raise Fault(f"bodies don't rest on the cloud's surface: {np.round(off, 3).tolist()}", metrics)
    return metrics
