"""Gazebo's own libraries (Debian's Fortress): libsdformat, ignition-common's MeshManager, ignition-physics with DART.

The world is parsed with warnings as errors, every mesh and texture is loaded, and triangles are counted; balls and
boxes of a car's size are dropped on the road (in rooms balls only), balls also on tile borders; the robot is driven
along the road. A lidar is simulated in what `gpu_lidar` renders: visuals as ignition-common loads them, at their poses,
by the rays of Bullet; its ranges are compared with this project's own ray casting, crowns and posts included, and it
must find intensities (`laser_retro`). Rendering itself (ignition-rendering, Ogre) isn't in Debian: it isn't verified.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.simulation.robot import ROBOT
from tests.fakes.gazebo import checker
from tests.fakes.world_checks import Fault, drive, drops, rays
from tests.fakes.world_checks.drive import Pose
from tests.fakes.world_checks.reference import WorldReference

FORMAT = "gazebo"
CAR_SIZE_M = (4.2, 1.8, 1.4)
MIN_CAR_DISTANCE_M = 6.0
"""Minimum distance between cars dropped at the same time."""


def missing() -> str:
    """Reason why Gazebo can't run here, or an empty string."""
    return checker.build()


def check(export: Path, reference: WorldReference) -> dict[str, Any]:
    """Load the world, drop bodies and drive the robot, see the module's docstring."""
    (world,) = export.glob("*.sdf")
    first, *others = _separate_groups(np.zeros((0, 3)) if reference.rooms else reference.road)
    bodies: list[checker.Body] = [("ball", (x, y, z)) for x, y, z in drops.start_positions(reference).tolist()]
    loaded = _check_world(world, [*bodies, *(("car", _start_above(point, reference)) for point in first)])
    cars = loaded["bodies"][len(bodies) :]
    for group in others:
        cars += _check_world(world, [("car", _start_above(point, reference)) for point in group])["bodies"]
    balls = drops.rest_gaps(np.array([body["rest"] for body in loaded["bodies"][: len(bodies)]]), reference)
    gaps = np.concatenate([balls, [_car_gap(car, reference) for car in cars]])
    metrics = {"meshes": len(loaded["meshes"]), "solids": loaded["solids"], **drops.rest_metrics(gaps)}
    metrics |= _lidar(world, reference)
    left, right = (f"{wheel.name}_joint" for wheel in ROBOT.wheels)
    with checker.SimulatedRobot(world, ROBOT.name, (left, right)) as robot:
        return metrics | drive.drive(_Robot(robot), reference)


def _lidar(world: Path, reference: WorldReference) -> dict[str, Any]:
    """Ranges and intensities of a simulated lidar."""
    if not reference.surfaces:
        return {}
    origins, directions = rays.rays(reference)
    try:
        ranges, retro = checker.cast_rays(world, origins, directions)
    except checker.WorldRejected as error:
        raise Fault(str(error)) from None
    return rays.compare(origins, directions, ranges, retro, reference.surfaces)


class _Robot:
    """The robot in Gazebo's physics."""

    def __init__(self, robot: checker.SimulatedRobot) -> None:
        self._robot = robot

    def pose(self) -> Pose:
        """Pose of the robot."""
        return Pose(np.asarray(self._robot.pose["rest"]), _rotation(self._robot.pose).as_matrix())

    def turn(self, left: float, right: float, seconds: float) -> None:
        """Turn the wheels at the given velocities for some time."""
        self._robot.turn(left, right, seconds)


def _check_world(world: Path, bodies: list[checker.Body]) -> dict[str, Any]:
    try:
        return checker.check_world(world, *bodies)
    except checker.WorldRejected as error:
        raise Fault(str(error)) from None


def _start_above(point: F64, reference: WorldReference) -> tuple[float, float, float]:
    """Initial position of a car's box: above the highest ground below it."""
    below = _underside()[:, :2] + point[:2]
    highest = float(np.nanmax([point[2], *reference.heights(below)]))
    return float(point[0]), float(point[1]), highest + CAR_SIZE_M[2] / 2 + drops.DROP_HEIGHT_M


def _underside() -> F64:
    """(81, 3) points on a car's underside, from its centre."""
    side = [np.linspace(-length / 2, length / 2, 9) for length in CAR_SIZE_M[:2]]
    return np.stack(np.meshgrid(*side, [-CAR_SIZE_M[2] / 2], indexing="ij"), axis=-1).reshape(-1, 3)


def _separate_groups(points: F64) -> list[list[F64]]:
    """Groups of points that are far from each other."""
    groups: list[list[F64]] = [[]]
    for point in points:
        group = next((g for g in groups if all(np.linalg.norm(point - p) > MIN_CAR_DISTANCE_M for p in g)), None)
        if group is None:
            groups.append(group := [])
        group.append(point)
    return groups


def _car_gap(body: dict[str, Any], reference: WorldReference) -> float:
    """Smallest gap in metres between a box' underside and the cloud's surface, away from kerbs."""
    under = _rotation(body).apply(_underside()) + body["rest"]
    under = under[~reference.at_kerb(under[:, :2])]
    gap = under[:, 2] - reference.heights(under[:, :2])
    return float(np.nanmin(gap))


def _rotation(body: dict[str, Any]) -> Rotation:
    """Orientation of a body."""
    return Rotation.from_quat(body["lies"], scalar_first=True)
