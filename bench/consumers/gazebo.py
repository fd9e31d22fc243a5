"""Gazebo's own libraries (Debian's Fortress): libsdformat, ignition-common's MeshManager, ignition-physics with DART.

The world is parsed with warnings as errors, every mesh and texture is loaded, triangles are counted; a ball and a box
of a car's size fall on the road, balls on the borders of tiles; the robot is driven along the road.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from bench.consumers import Fault
from bench.gate import drive, drops
from bench.gate.drive import Pose
from bench.gate.places import Places
from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.simulation.robot import ROBOT
from tests.gazebo import checker

FORMAT = "gazebo"
CAR = (4.2, 1.8, 1.4)
APART = 6.0
"""Metres between cars that fall at the same time."""


def missing() -> str:
    """Why it can't run here, or an empty text."""
    return checker.built()


def check(export: Path, places: Places) -> dict[str, Any]:
    """Load the world, and drop bodies; see the package."""
    (world,) = export.glob("*.sdf")
    first, *others = _apart(places.road)
    bodies: list[checker.Body] = [("ball", (x, y, z)) for x, y, z in drops.starts(places).tolist()]
    seen = _checked(world, [*bodies, *(("car", _over(place, places)) for place in first)])
    cars = seen["bodies"][len(bodies) :]
    for group in others:
        cars += _checked(world, [("car", _over(place, places)) for place in group])["bodies"]
    balls = drops.gaps(np.array([body["rest"] for body in seen["bodies"][: len(bodies)]]), places)
    off = np.concatenate([balls, [_car_off(car, places) for car in cars]])
    figures = {"meshes": len(seen["meshes"]), "solids": seen["solids"], **drops.told(off)}
    left, right = (f"{wheel.name}_joint" for wheel in ROBOT.wheels)
    with checker.Driven(world, ROBOT.name, (left, right)) as driven:
        return figures | drive.drive(_Robot(driven), places)


class _Robot:
    """The robot in Gazebo's physics."""

    def __init__(self, driven: checker.Driven) -> None:
        self._driven = driven

    def pose(self) -> Pose:
        """Where the robot is."""
        return Pose(np.asarray(self._driven.place["rest"]), _rotation(self._driven.place).as_matrix())

    def turn(self, left: float, right: float, seconds: float) -> None:
        """Have the wheels turn so fast for a time."""
        self._driven.turn(left, right, seconds)


def _checked(world: Path, bodies: list[checker.Body]) -> dict[str, Any]:
    try:
        return checker.check_world(world, *bodies)
    except checker.Refused as why:
        raise Fault(str(why)) from None


def _over(place: F64, places: Places) -> tuple[float, float, float]:
    """Where a car's box begins to fall: over the highest ground below it."""
    below = _underside()[:, :2] + place[:2]
    highest = float(np.nanmax([place[2], *places.heights(below)]))
    return float(place[0]), float(place[1]), highest + CAR[2] / 2 + drops.FALL


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


def _car_off(body: dict[str, Any], places: Places) -> float:
    """Metres between a box' underside and the cloud's surface, where it is nearest to it."""
    under = _rotation(body).apply(_underside()) + body["rest"]
    gap = under[:, 2] - places.heights(under[:, :2])
    return float(np.nanmin(gap))


def _rotation(body: dict[str, Any]) -> Rotation:
    """Of how a body lies."""
    return Rotation.from_quat(body["lies"], scalar_first=True)
