"""CARLA's own reader of OpenDRIVE, without its server: `carla.Map`, asked for the lanes along the way that one drives.

Where it isn't told which way lanes go they are "bidirectional": CARLA knows such lanes, but has no traffic on them
(`driving`: its waypoints a metre apart, which are of driving lanes alone).
"""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np

from bench.consumers import Fault
from bench.gate.places import Places

FORMAT = "opendrive"
EVERY = 2
"""Every so many places of the way are asked for."""
HEIGHT = 0.1
"""Metres between a lane and the cloud's surface, p95."""


def missing() -> str:
    """Why it can't run here, or an empty text."""
    return "" if importlib.util.find_spec("carla") else "CARLA's library isn't installed (pip install carla)"


def check(export: Path, places: Places) -> dict[str, Any]:
    """Wherever one drives there is a lane, whose middle lies on the road, at its height."""
    import carla

    (path,) = export.glob("*.xodr")
    try:
        roads = carla.Map(path.stem, path.read_text(encoding="utf-8"))
    except RuntimeError as why:
        raise Fault(str(why)) from None
    kinds = carla.LaneType.Driving, carla.LaneType.Bidirectional
    asked = [carla.Location(x, -y, z) for x, y, z in places.ways[0][::EVERY].tolist()]  # CARLA is left-handed
    lanes = [[roads.get_waypoint(at, project_to_road=False, lane_type=kind) for kind in kinds] for at in asked]
    found = [next(filter(None, of_place), None) for of_place in lanes]
    at = [waypoint.transform.location for waypoint in found if waypoint]
    xyz = np.array([(one.x, -one.y, one.z) for one in at]).reshape(-1, 3)
    heights = places.heights(xyz[:, :2])
    seen = np.isfinite(heights)
    figures: dict[str, Any] = {
        "places": len(asked),
        "without_lane": found.count(None),
        "driving": len(roads.generate_waypoints(1.0)),
        "beside_road": int(np.sum(~places.on_road(xyz[seen, :2]))),
        "height_p95_m": round(float(np.percentile(np.abs(xyz[seen, 2] - heights[seen]), 95)), 3)
        if seen.any()
        else None,
    }
    if figures["without_lane"] or figures["beside_road"] or not seen.any() or figures["height_p95_m"] > HEIGHT:
        raise Fault("its lanes aren't where the road is", figures)
    return figures
