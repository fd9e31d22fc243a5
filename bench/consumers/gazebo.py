"""Gazebo's own libraries (Debian's Fortress): libsdformat, ignition-common's MeshManager, ignition-physics with DART.

The world is parsed with warnings as errors, every mesh and texture is loaded, triangles are counted; a ball and a box
of a car's size fall on the road, balls on the borders of tiles.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from bench.consumers import Fault
from bench.gate_places import Places
from scan2sim.pipeline.types import F64
from tests.gazebo import checker

FORMAT = "gazebo"
BALL, CAR = 0.11, (4.2, 1.8, 1.4)
FALL, APART = 0.15, 6.0
"""Metres that bodies fall, and between cars that fall at the same time."""
WITHIN = 0.02
"""Metres from the cloud's surface within which a body comes to rest."""
THROUGH = 0.3
"""Metres below it where a body has fallen through."""


def missing() -> str:
    """Why it can't run here, or an empty text."""
    return checker.built()


def check(export: Path, places: Places) -> dict[str, Any]:
    """Load the world, and drop bodies; see the package."""
    (world,) = export.glob("*.sdf")
    balls = np.concatenate([places.road, places.borders])
    first, *others = _apart(places.road)
    bodies = [("ball", (*place[:2], place[2] + BALL + FALL)) for place in balls]
    seen = _checked(world, [*bodies, *(("car", _over(place, places)) for place in first)])
    cars = seen["bodies"][len(bodies) :]
    for group in others:
        cars += _checked(world, [("car", _over(place, places)) for place in group])["bodies"]
    off = [_ball_off(body, places) for body in seen["bodies"][: len(bodies)]] + [_car_off(car, places) for car in cars]
    figures = {
        "meshes": len(seen["meshes"]),
        "solids": seen["solids"],
        "dropped": len(off),
        "drop_mean_m": round(float(np.nanmean(np.abs(off))), 4),
        "drop_max_m": round(float(np.nanmax(np.abs(off))), 4),
        "fell_through": int(np.sum(np.asarray(off) < -THROUGH)),
    }
    if figures["fell_through"] or figures["drop_max_m"] > WITHIN or np.isnan(off).any():
        raise Fault(f"bodies don't come to rest on the cloud's surface: {figures}, {np.round(off, 3).tolist()}")
    return figures


def _checked(world: Path, bodies: list[checker.Body]) -> dict[str, Any]:
    try:
        return checker.check_world(world, *bodies)
    except checker.Refused as why:
        raise Fault(str(why)) from None


def _over(place: F64, places: Places) -> tuple[float, float, float]:
    """Where a car's box begins to fall: over the highest ground below it."""
    below = _underside()[:, :2] + place[:2]
    highest = float(np.nanmax([place[2], *places.heights(below)]))
    return float(place[0]), float(place[1]), highest + CAR[2] / 2 + FALL


def _underside() -> F64:
    """(81, 3) places on a car's underside, from its centre."""
    side = [np.linspace(-length / 2, length / 2, 9) for length in CAR[:2]]
    return np.stack(np.meshgrid(*side, [-CAR[2] / 2], indexing="ij"), axis=-1).reshape(-1, 3)


def _apart(places: F64) -> list[list[F64]]:
    """Places shared out to groups in which none is near another."""
    groups: list[list[F64]] = [[]]
    for place in places:
        group = next((g for g in groups if all(np.linalg.norm(place - p) > APART for p in g)), None)
        if group is None:
            groups.append(group := [])
        group.append(place)
    return groups


def _ball_off(body: dict[str, Any], places: Places) -> float:
    """Metres between a ball's lowest place and the cloud's surface."""
    x, y, z = body["rest"]
    return float(z - BALL - places.heights(np.array([[x, y]]))[0])


def _car_off(body: dict[str, Any], places: Places) -> float:
    """Metres between a box' underside and the cloud's surface, where it is nearest to it."""
    from scipy.spatial.transform import Rotation

    w, x, y, z = body["lies"]
    under = Rotation.from_quat([x, y, z, w]).apply(_underside()) + body["rest"]
    gap = under[:, 2] - places.heights(under[:, :2])
    return float(np.nanmin(gap))
