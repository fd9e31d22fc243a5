"""The robot of an export is driven along the road in a consumer's engine, by pure pursuit (Coulter 1992)."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np

from bench.consumers import Fault
from bench.gate.places import Places
from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.simulation.robot import ROBOT

FAR = 20.0
"""Metres to drive, or to the way's end."""
SPEED, AHEAD = 1.0, 1.5
"""Metres a second, and metres ahead of the robot of the place that it steers for."""
TICK = 0.05
"""Seconds between two looks."""
UPRIGHT = 0.9
"""Cosine of the tilt at which a robot has fallen over."""


class Pose(NamedTuple):
    """Of the robot's frame: place (3,) in the world, metres, and rotation (3, 3) to it."""

    place: F64
    rotation: F64


class Engine(Protocol):
    """A world with the robot in it."""

    def pose(self) -> Pose:
        """Where the robot is."""

    def turn(self, left: float, right: float, seconds: float) -> None:
        """Have the wheels turn so fast, radians a second, for a time."""


def drive(engine: Engine, places: Places) -> dict[str, Any]:
    """Drive along the way that the robot stands on.

    Returns:
        `robot_driven_m`; `robot_off_way_max_m`: metres to the side of the way; `robot_left_road`: looks at which a
        wheel was on other ground than a road; `robot_above_max_m`: metres between its wheels and the cloud's surface.

    Raises:
        Fault: it left the road, fell over, or got stuck.
    """
    pose = engine.pose()
    way = min(places.ways, key=lambda one: float(np.linalg.norm(one - pose.place, axis=1).min()))
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(way[:, :2], axis=0), axis=1))])
    first = _chainage(way, along, pose.place)
    far = min(FAR, along[-1] - first - AHEAD)
    left, aside, above, driven = 0, 0.0, 0.0, 0.0
    for _ in range(int(3 * far / SPEED / TICK)):
        engine.turn(*ROBOT.turning(SPEED, _steering(way, along, pose)), TICK)
        pose = engine.pose()
        if pose.rotation[2, 2] < UPRIGHT:
            raise Fault(f"the robot fell over after {driven:.1f} m at {np.round(pose.place, 2).tolist()}")
        below = _wheels(pose)
        left += not places.on_road(below[:, :2]).all()
        above = max(above, float(np.nanmax(np.abs(below[:, 2] - places.heights(below[:, :2])), initial=0.0)))
        at = _chainage(way, along, pose.place)
        aside = max(aside, float(np.linalg.norm(_place(way, along, at) - pose.place[:2])))
        driven = at - first
        if driven >= far:
            break
    figures = {
        "robot_driven_m": round(driven, 2),
        "robot_off_way_max_m": round(aside, 3),
        "robot_above_max_m": round(above, 3),
        "robot_left_road": left,
    }
    if driven < far or left:
        raise Fault(f"the robot was to drive {far:.1f} m along the road", figures)
    return figures


def _chainage(way: F64, along: F64, place: F64) -> float:
    """Metres along a way (W, 2 or 3) to the place on it that is nearest."""
    i = int(np.linalg.norm(way[:, :2] - place[:2], axis=1)[:-1].argmin())
    step = way[i + 1, :2] - way[i, :2]
    share = float((place[:2] - way[i, :2]) @ step / max(float(step @ step), 1e-9))
    return float(along[i] + share * (along[i + 1] - along[i]))


def _place(way: F64, along: F64, at: float) -> F64:
    """(2,) the place on a way at a chainage."""
    return np.array([np.interp(at, along, k) for k in way[:, :2].T])


def _steering(way: F64, along: F64, pose: Pose) -> float:
    """Radians a second to the left."""
    at = _chainage(way, along, pose.place) + AHEAD
    goal = _place(way, along, at) - pose.place[:2]
    aside = float(goal @ pose.rotation[:2, 1])
    return 2 * SPEED * aside / max(float(goal @ goal), 1e-6)


def _wheels(pose: Pose) -> F64:
    """(3, 3) the lowest places of the wheels and the caster."""
    touching = [(x, y, 0.0) for x, y, _ in (link.place for link in (*ROBOT.wheels, ROBOT.link("caster")))]
    return np.asarray(touching) @ pose.rotation.T + pose.place
