"""A car simulated on the ground of a finished world: a kinematic bicycle that stands on it, and stops where it hits.

The bicycle is that of the middle of the rear axle (LaValle, Planning Algorithms, section 13.1.2.1). Speed and steering
change no faster than the car's limits. It doesn't skid, tilt in bends or fall; the ground only carries it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import copysign, cos, hypot, sin, tan
from typing import TYPE_CHECKING

import numpy as np

from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.io.worlds.scene import Scene
from scan2sim.pipeline.simulation import spawn
from scan2sim.services.teleoperation.control.controls import Controls, Gear, VehicleState

if TYPE_CHECKING:
    from open3d.t.geometry import RaycastingScene

LONGEST_STEP = 0.02
"""Seconds that are computed at once."""
CRAWL = 0.5
"""Metres a second below which another gear goes in."""
CLIMB = 1.0
"""Metres above where it stands from where the ground is looked for: kerbs and slopes, but no bridge or crown above."""
STEP = 0.3
"""Metres by which the ground may differ between its wheels beyond a slope of one in three: else it is an edge."""


@dataclass(frozen=True)
class Car:
    """A car as data: that of a small city car.

    Attributes:
        wheelbase, track, width: metres; front, rear: from the axles to the bumpers.
        steering: radians of the front wheels at most; turning: radians a second.
        acceleration, braking, rolling: metres a second squared; rolling: with neither throttle nor brake.
        fastest, backwards: metres a second.
    """

    wheelbase: float = 2.5
    track: float = 1.45
    width: float = 1.65
    front: float = 0.7
    rear: float = 0.6
    steering: float = 0.6
    turning: float = 0.8
    acceleration: float = 2.5
    braking: float = 7.0
    rolling: float = 0.3
    fastest: float = 14.0
    backwards: float = 3.0


@dataclass
class Bicycle:
    """Where a car is and how it moves.

    Attributes:
        x, y: of the middle of the rear axle, metres; heading: radians from the x axis, anticlockwise.
        speed: metres a second, negative backwards; steering: radians of the front wheels, positive to the left.
    """

    car: Car = field(default_factory=Car)
    x: float = 0.0
    y: float = 0.0
    heading: float = 0.0
    speed: float = 0.0
    steering: float = 0.0
    gear: Gear = Gear.NEUTRAL

    def step(self, controls: Controls, seconds: float) -> None:
        """Go on for so long, at most `LONGEST_STEP`."""
        car = self.car
        if controls.gear == self.gear or abs(self.speed) < CRAWL:
            self.gear = controls.gear
        aim = controls.steering * car.steering
        self.steering += float(np.clip(aim - self.steering, -car.turning * seconds, car.turning * seconds))
        before, self.speed = self.speed, self._speed(controls, seconds)
        way = (before + self.speed) / 2 * seconds
        turn = way * tan(self.steering) / car.wheelbase
        self.x += way * cos(self.heading + turn / 2)
        self.y += way * sin(self.heading + turn / 2)
        self.heading += turn

    def _speed(self, controls: Controls, seconds: float) -> float:
        car = self.car
        push = controls.throttle * car.acceleration * self.gear if self.gear == controls.gear else 0.0
        drag = controls.brake * car.braking + car.rolling * (push == 0.0)
        speed = self.speed + push * seconds
        slowed = max(abs(speed) - drag * seconds, 0.0)  # brakes don't drive backwards
        return float(np.clip(copysign(slowed, speed), -car.backwards, car.fastest))


class Ground:
    """What of a world carries a car, and what it runs into; world metres, from the scene's origin.

    Attributes:
        start: where a car starts: x, y, heading; height: of the ground there.

    Raises:
        DataError: the world knows of no place to start from.
    """

    def __init__(self, scene: Scene, car: Car | None = None) -> None:
        self.car = car or Car()
        found = spawn.find(scene)
        self.start = found.position[0], found.position[1], found.angles[2]
        self.height = found.position[2]
        self._ground: RaycastingScene
        self._others: RaycastingScene
        self._ground, self._others = spawn.bodies(scene)

    def pose(self, x: float, y: float, heading: float, near: float) -> F64 | None:
        """(4, 4) of a car to the world: x ahead, y to the left, z up, from below the middle of its rear axle.

        Args:
            near: height that it had last.

        Returns:
            None where the ground doesn't carry all its wheels.
        """
        car = self.car
        ahead, left = np.array([cos(heading), sin(heading)]), np.array([-sin(heading), cos(heading)])
        side = car.track / 2
        wheels = np.array([[0.0, side], [0.0, -side], [car.wheelbase, side], [car.wheelbase, -side]])
        under = np.array([x, y]) + wheels[:, :1] * ahead + wheels[:, 1:] * left
        heights = spawn.heights(self._ground, under, near + CLIMB)
        plane = np.column_stack([wheels, np.ones(4)])
        if not np.isfinite(heights).all() or heights.min() < near - CLIMB:
            return None
        (slope, tilt, height), *_ = np.linalg.lstsq(plane, heights, rcond=None)
        if np.abs(plane @ (slope, tilt, height) - heights).max() > STEP or hypot(slope, tilt) > 1.0:
            return None
        forward = np.array([*ahead, slope]) / hypot(1.0, slope)
        up = np.cross(forward, [*left, tilt])
        up /= np.linalg.norm(up)
        pose = np.eye(4)
        pose[:3, :3] = np.column_stack([forward, np.cross(up, forward), up])
        pose[:3, 3] = x, y, height
        return pose

    def room(self, pose: F64) -> float:
        """Metres from a car to what isn't ground; negative: it is inside, by so much."""
        car = self.car
        radius = car.width / 2
        along = np.linspace(radius - car.rear, car.wheelbase + car.front - radius, 4)
        middles = pose[:3, 3] + along[:, None] * pose[:3, 0] + (radius + 0.2) * pose[:3, 2]
        return float(self._others.compute_distance(middles.astype(np.float32)).numpy().min()) - radius


class SimulatedCar:
    """A car in a world; time is given from outside.

    Attributes:
        pose: (4, 4) of the car to the world (`Ground.pose`).
        fault: what stopped it, in words; "": nothing.
    """

    def __init__(self, ground: Ground) -> None:
        self._ground = ground
        x, y, heading = ground.start
        self.bicycle = Bicycle(ground.car, x, y, heading)
        pose = ground.pose(x, y, heading, ground.height)
        self.pose = np.eye(4) if pose is None else pose
        if pose is None:
            self.pose[:2, 3], self.pose[2, 3] = (x, y), ground.height
        self._room = ground.room(self.pose)
        self.fault = ""

    def go(self, controls: Controls, seconds: float) -> None:
        """Drive on for so long."""
        while seconds > 1e-9:
            self._step(controls, min(seconds, LONGEST_STEP))
            seconds -= LONGEST_STEP

    def state(self) -> VehicleState:
        """What it tells of itself; position in world metres."""
        one = self.bicycle
        return VehicleState(one.speed, (one.x, one.y), one.heading, one.gear, (self.fault,) if self.fault else ())

    def _step(self, controls: Controls, seconds: float) -> None:
        one = self.bicycle
        before = one.x, one.y, one.heading
        one.step(controls, seconds)
        if (one.x, one.y, one.heading) == before:
            return
        pose = self._ground.pose(one.x, one.y, one.heading, self.pose[2, 3])
        room = -np.inf if pose is None else self._ground.room(pose)
        if pose is None or (room < 0 and room < self._room):  # who is inside may get out
            one.x, one.y, one.heading = before
            one.speed, self.fault = 0.0, "the ground ends here" if pose is None else "it has run into something"
            return
        self.pose, self._room, self.fault = pose, room, ""


class Place:
    """Where a car stands, of what it tells: for cameras of the same world in another process than the car."""

    def __init__(self, ground: Ground) -> None:
        self._ground, self._pose = ground, SimulatedCar(ground).pose

    def __call__(self, state: VehicleState) -> F64:
        """(4, 4) of the car to the world; the last one where it doesn't tell where it is."""
        if state.position is not None and state.heading is not None:
            pose = self._ground.pose(*state.position, state.heading, self._pose[2, 3])
            self._pose = self._pose if pose is None else pose
        return self._pose
