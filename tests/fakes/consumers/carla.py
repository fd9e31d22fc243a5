"""CARLA's OpenDRIVE parser without its server: `carla.Map` is queried for lanes along the route.

Lanes whose direction isn't known are "bidirectional": CARLA knows such lanes, but has no traffic on them (`driving`:
number of waypoints a metre apart, which exist for driving lanes only).
"""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np

from tests.fakes.world_checks import Fault
from tests.fakes.world_checks.reference import WorldReference

FORMAT = "opendrive"
ROUTE_STRIDE = 2
"""Every Nth point of the route is checked."""
MAX_HEIGHT_ERROR_M = 0.1
"""Maximum distance between a lane and the cloud's surface, p95."""


def missing() -> str:
    """Reason why it can't run here, or an empty string."""
    return "" if importlib.util.find_spec("carla") else "CARLA's library isn't installed (pip install carla)"


def check(export: Path, reference: WorldReference) -> dict[str, Any]:
    """Check that there is a lane everywhere along the route, centred on the road and at its height."""
    import carla

    (path,) = export.glob("*.xodr")
    try:
        roads = carla.Map(path.stem, path.read_text(encoding="utf-8"))
    except RuntimeError as error:
        raise Fault(str(error)) from None
    kinds = carla.LaneType.Driving, carla.LaneType.Bidirectional
    route = [carla.Location(x, -y, z) for x, y, z in reference.ways[0][::ROUTE_STRIDE].tolist()]  # CARLA is left-handed
    lanes = [[roads.get_waypoint(at, project_to_road=False, lane_type=kind) for kind in kinds] for at in route]
    found = [next(filter(None, waypoints), None) for waypoints in lanes]
    locations = [waypoint.transform.location for waypoint in found if waypoint]
    xyz = np.array([(one.x, -one.y, one.z) for one in locations]).reshape(-1, 3)
    heights = reference.heights(xyz[:, :2])
    known = np.isfinite(heights)
    metrics: dict[str, Any] = {
        "places": len(route),
        "without_lane": found.count(None),
        "driving": len(roads.generate_waypoints(1.0)),
        "beside_road": int(np.sum(~reference.on_road(xyz[known, :2]))),
        "height_p95_m": round(float(np.percentile(np.abs(xyz[known, 2] - heights[known]), 95)), 3)
        if known.any()
        else None,
    }
    if (
        metrics["without_lane"]
        or metrics["beside_road"]
        or not known.any()
        or metrics["height_p95_m"] > MAX_HEIGHT_ERROR_M
    ):
        raise Fault("its lanes don't match the road", metrics)
    return metrics
