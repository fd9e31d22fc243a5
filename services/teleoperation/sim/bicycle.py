"""A simulated car in a finished world: a kinematic bicycle model on its ground, which stops at collisions.

The model's reference point is the middle of the rear axle (LaValle, Planning Algorithms, section 13.1.2.1). Speed and
steering change within the car's limits. The car doesn't skid, roll or fall; it follows the slope of the ground.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import copysign, cos, hypot, sin, tan
from typing import TYPE_CHECKING

import numpy as np

from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.io.worlds import spawn
from scan2sim.pipeline.io.worlds.scene import Scene
from scan2sim.services.teleoperation.control.controls import Controls, Gear, VehicleState

if TYPE_CHECKING:
    from open3d.t.geometry import RaycastingScene

STEP_MAX_S = 0.02
"""Maximum time step of the integration."""
GEAR_CHANGE_SPEED_MAX_MPS = 0.5
"""Speed below which another gear is engaged."""
GROUND_SEARCH_M = 1.0
"""The ground is searched this far above the car's last height: kerbs and slopes, but not bridges or tree crowns."""
WHEEL_STEP_MAX_M = 0.3
"""Maximum distance of the ground at a wheel from the plane fitted through all wheels; more is an edge."""


@dataclass(frozen=True)
class Car:
    """Parameters of a car; defaults are those of a small city car.

    Attributes:
        wheelbase, track, width: metres; front, rear: distance from the axles to the bumpers, metres.
        steering: maximum angle of the front wheels, rad; steering_rate: rad/s.
        acceleration, braking, rolling: m/s²; rolling: deceleration with neither throttle nor brake.
        max_speed, max_reverse_speed: m/s.
    """

    wheelbase: float = 2.5
    track: float = 1.45
    width: float = 1.65
    front: float = 0.7
    rear: float = 0.6
    steering: float = 0.6
    steering_rate: float = 0.8
    acceleration: float = 2.5
    braking: float = 7.0
    rolling: float = 0.3
    max_speed: float = 14.0
    max_reverse_speed: float = 3.0


@dataclass
class Bicycle:
    """State of a kinematic bicycle model.

    Attributes:
        x, y: position of the middle of the rear axle, metres; heading: radians from the x axis, anticlockwise.
        speed: m/s, negative backwards; steering: angle of the front wheels, rad, positive to the left.
    """

    car: Car = field(default_factory=Car)
    x: float = 0.0
    y: float = 0.0
    heading: float = 0.0
    speed: float = 0.0
    steering: float = 0.0
    gear: Gear = Gear.NEUTRAL

    def step(self, controls: Controls, seconds: float) -> None:
        """Advance by a time step of at most `STEP_MAX_S`."""
        car = self.car
        if controls.gear == self.gear or abs(self.speed) < GEAR_CHANGE_SPEED_MAX_MPS:
            self.gear = controls.gear
        target = controls.steering * car.steering
        self.steering += float(
            np.clip(target - self.steering, -car.steering_rate * seconds, car.steering_rate * seconds)
        )
        before, self.speed = self.speed, self._speed(controls, seconds)
        distance = (before + self.speed) / 2 * seconds
        turn = distance * tan(self.steering) / car.wheelbase
        self.x += distance * cos(self.heading + turn / 2)
        self.y += distance * sin(self.heading + turn / 2)
        self.heading += turn

    def _speed(self, controls: Controls, seconds: float) -> float:
        car = self.car
        push = controls.throttle * car.acceleration * self.gear if self.gear == controls.gear else 0.0
        drag = controls.brake * car.braking + car.rolling * (push == 0.0)
        speed = self.speed + push * seconds
        slowed = max(abs(speed) - drag * seconds, 0.0)  # drag must not reverse the motion
        return float(np.clip(copysign(slowed, speed), -car.max_reverse_speed, car.max_speed))


class Ground:
    """Drivable ground and obstacles of a world; metres, from the scene's origin.

    Attributes:
        start: initial x, y, heading of a car; height: of the ground there.

    Raises:
        DataError: the world has no drivable place to start from.
    """

    def __init__(self, scene: Scene, car: Car | None = None) -> None:
        self.car = car or Car()
        found = spawn.find_spawn_pose(scene)
        self.start = found.position[0], found.position[1], found.angles[2]
        self.height = found.position[2]
        self._ground: RaycastingScene
        self._obstacles: RaycastingScene
        self._ground, self._obstacles = spawn.bodies(scene)

    def pose(self, x: float, y: float, heading: float, last_height: float) -> F64 | None:
        """Pose (4, 4) of a car in the world: x ahead, y left, z up, origin on the ground below the rear axle's middle.

        Args:
            last_height: last height of the car.

        Returns:
            None if the ground doesn't carry all wheels.
        """
        car = self.car
        ahead, left = np.array([cos(heading), sin(heading)]), np.array([-sin(heading), cos(heading)])
        side = car.track / 2
        wheels = np.array([[0.0, side], [0.0, -side], [car.wheelbase, side], [car.wheelbase, -side]])
        ground_points = np.array([x, y]) + wheels[:, :1] * ahead + wheels[:, 1:] * left
        heights = spawn.heights(self._ground, ground_points, last_height + GROUND_SEARCH_M)
        plane = np.column_stack([wheels, np.ones(4)])
        if not np.isfinite(heights).all() or heights.min() < last_height - GROUND_SEARCH_M:
            return None
        (slope, tilt, height), *_ = np.linalg.lstsq(plane, heights, rcond=None)
        if np.abs(plane @ (slope, tilt, height) - heights).max() > WHEEL_STEP_MAX_M or hypot(slope, tilt) > 1.0:
            return None
        forward = np.array([*ahead, slope]) / hypot(1.0, slope)
        up = np.cross(forward, [*left, tilt])
        up /= np.linalg.norm(up)
        pose = np.eye(4)
        pose[:3, :3] = np.column_stack([forward, np.cross(up, forward), up])
        pose[:3, 3] = x, y, height
        return pose

    def clearance(self, pose: F64) -> float:
        """Distance from a car to the nearest obstacle, metres; negative: penetration depth."""
        car = self.car
        radius = car.width / 2
        along = np.linspace(radius - car.rear, car.wheelbase + car.front - radius, 4)
        middles = pose[:3, 3] + along[:, None] * pose[:3, 0] + (radius + 0.2) * pose[:3, 2]
        return float(self._obstacles.compute_distance(middles.astype(np.float32)).numpy().min()) - radius


class SimulatedCar:
    """A car in a world; the caller advances its time.

    Attributes:
        pose: (4, 4) of the car in the world (`Ground.pose`).
        fault: what stopped it; "": nothing.
    """

    def __init__(self, ground: Ground) -> None:
        self._ground = ground
        x, y, heading = ground.start
        self.bicycle = Bicycle(ground.car, x, y, heading)
        pose = ground.pose(x, y, heading, ground.height)
        self.pose = np.eye(4) if pose is None else pose
        if pose is None:
            self.pose[:2, 3], self.pose[2, 3] = (x, y), ground.height
        self._clearance = ground.clearance(self.pose)
        self.fault = ""

    def advance(self, controls: Controls, seconds: float) -> None:
        """Drive for a duration."""
        while seconds > 1e-9:
            self._step(controls, min(seconds, STEP_MAX_S))
            seconds -= STEP_MAX_S

    def state(self) -> VehicleState:
        """State of the car; position in world metres."""
        one = self.bicycle
        return VehicleState(one.speed, (one.x, one.y), one.heading, one.gear, (self.fault,) if self.fault else ())

    def _step(self, controls: Controls, seconds: float) -> None:
        one = self.bicycle
        before = one.x, one.y, one.heading
        one.step(controls, seconds)
        if (one.x, one.y, one.heading) == before:
            return
        pose = self._ground.pose(one.x, one.y, one.heading, self.pose[2, 3])
        clearance = -np.inf if pose is None else self._ground.clearance(pose)
        if pose is None or (clearance < 0 and clearance < self._clearance):  # a car inside an obstacle may drive out
            one.x, one.y, one.heading = before
            one.speed, self.fault = 0.0, "end of the drivable ground" if pose is None else "collision with an obstacle"
            return
        self.pose, self._clearance, self.fault = pose, clearance, ""


class PoseTracker:
    """Pose of a car from its reported state: for cameras that run in another process than the car."""

    def __init__(self, ground: Ground) -> None:
        self._ground, self._pose = ground, SimulatedCar(ground).pose

    def __call__(self, state: VehicleState) -> F64:
        """Pose (4, 4) of the car in the world; the last one if the state has no position."""
        if state.position is not None and state.heading is not None:
            pose = self._ground.pose(*state.position, state.heading, self._pose[2, 3])
            self._pose = self._pose if pose is None else pose
        return self._pose
