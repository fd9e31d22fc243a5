"""Drive the exported robot along the road in a consumer's physics engine, with pure pursuit (Coulter 1992)."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np

from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.simulation.robot import ROBOT
from tests.fakes.world_checks import Fault
from tests.fakes.world_checks.reference import WorldReference

DRIVE_DISTANCE_M = 20.0
"""Distance to drive, if the route is long enough."""
SPEED_M_S, LOOKAHEAD_M = 1.0, 1.5
"""Speed, and distance from the robot to the point that it steers for."""
CONTROL_PERIOD_S = 0.05
"""Time between two control updates."""
MIN_UPRIGHT = 0.9
"""Cosine of the tilt at which a robot counts as fallen over."""


class Pose(NamedTuple):
    """Pose of the robot's base frame: position (3,) in the world, metres, and rotation (3, 3) to the world."""

    position: F64
    rotation: F64


class Engine(Protocol):
    """A simulated world with the robot in it."""

    def pose(self) -> Pose:
        """Pose of the robot."""

    def turn(self, left: float, right: float, seconds: float) -> None:
        """Turn the wheels at the given angular velocities, rad/s, for some time."""


def drive(engine: Engine, reference: WorldReference) -> dict[str, Any]:
    """Drive along the route nearest to the robot.

    Returns:
        `robot_driven_m`; `robot_off_way_max_m`: lateral distance from the route; `robot_left_road`: number of updates
        with a wheel off the road; `robot_above_max_m`: distance between its wheels and the cloud's surface.

    Raises:
        Fault: it left the road, fell over or got stuck.
    """
    pose = engine.pose()
    route = min(reference.ways, key=lambda one: float(np.linalg.norm(one - pose.position, axis=1).min()))
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(route[:, :2], axis=0), axis=1))])
    first = _chainage(route, along, pose.position)
    goal_distance = min(DRIVE_DISTANCE_M, along[-1] - first - LOOKAHEAD_M)
    left, max_lateral, max_above, driven = 0, 0.0, 0.0, 0.0
    for _ in range(int(3 * goal_distance / SPEED_M_S / CONTROL_PERIOD_S)):
        engine.turn(*ROBOT.wheel_speeds(SPEED_M_S, _steering(route, along, pose)), CONTROL_PERIOD_S)
        pose = engine.pose()
        if pose.rotation[2, 2] < MIN_UPRIGHT:
            raise Fault(f"the robot fell over after {driven:.1f} m at {np.round(pose.position, 2).tolist()}")
        wheels = _wheels(pose)
        left += not reference.on_road(wheels[:, :2]).all()
        gaps = np.abs(wheels[:, 2] - reference.heights(wheels[:, :2]))
        max_above = max(max_above, float(np.nanmax(gaps, initial=0.0)))
        chainage = _chainage(route, along, pose.position)
        max_lateral = max(max_lateral, float(np.linalg.norm(_point_at(route, along, chainage) - pose.position[:2])))
        driven = chainage - first
        if driven >= goal_distance:
            break
    metrics = {
        "robot_driven_m": round(driven, 2),
        "robot_off_way_max_m": round(max_lateral, 3),
        "robot_above_max_m": round(max_above, 3),
        "robot_left_road": left,
    }
    if driven < goal_distance or left:
        raise Fault(f"the robot didn't drive {goal_distance:.1f} m on the road", metrics)
    return metrics


def _chainage(route: F64, along: F64, position: F64) -> float:
    """Distance along a route (W, 2 or 3) to its point nearest to a position."""
    i = int(np.linalg.norm(route[:, :2] - position[:2], axis=1)[:-1].argmin())
    step = route[i + 1, :2] - route[i, :2]
    share = float((position[:2] - route[i, :2]) @ step / max(float(step @ step), 1e-9))
    return float(along[i] + share * (along[i + 1] - along[i]))


def _point_at(route: F64, along: F64, chainage: float) -> F64:
    """(2,) point on a route at a distance along it."""
    return np.array([np.interp(chainage, along, k) for k in route[:, :2].T])


def _steering(route: F64, along: F64, pose: Pose) -> float:
    """Yaw rate in rad/s, positive to the left."""
    ahead = _chainage(route, along, pose.position) + LOOKAHEAD_M
    goal = _point_at(route, along, ahead) - pose.position[:2]
    lateral = float(goal @ pose.rotation[:2, 1])
    return 2 * SPEED_M_S * lateral / max(float(goal @ goal), 1e-6)


def _wheels(pose: Pose) -> F64:
    """(3, 3) lowest points of the wheels and the caster."""
    touching = [(x, y, 0.0) for x, y, _ in (link.place for link in (*ROBOT.wheels, ROBOT.link("caster")))]
    return np.asarray(touching) @ pose.rotation.T + pose.position
