"""A scripted drive along a world's street: reference path, steering, and cross-track error.

The reference path follows the longest lane, swerves to its left and back. Steering is pure pursuit (Coulter 1992) of a
lookahead point on the path, from the vehicle state as it arrives over the links, with their delay.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from math import atan, cos, hypot, sin, tau

import numpy as np

from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.io.worlds.scene import Scene
from scan2sim.pipeline.io.worlds.spawn import courses
from scan2sim.services.teleoperation.control.controls import Controls, VehicleState
from scan2sim.services.teleoperation.sim.bicycle import Car, Ground, SimulatedCar
from scan2sim.services.teleoperation.vehicle.adapters.simulated import SimulatedVehicle

LANE_OFFSET_M = 2.5
"""Maximum offset of the path to the left of its lane, reached in the middle."""
POINT_SPACING_M = 0.25
"""Distance between points of the path."""
LOOKAHEAD_S, LOOKAHEAD_MIN_M = 0.7, 2.5
"""Distance to the lookahead point: seconds at the current speed, and at least these metres."""
LOG_SPACING_M = 0.1
"""Distance between recorded positions of the car: every metre has equal weight, at any speed."""
END_TOLERANCE_M = 1.0
"""A drive is complete at this distance from the end of the path."""


def reference_path(scene: Scene, ground: Ground) -> F64:
    """Points (N, 2) of the path from the car's start to the end of its lane, world metres."""
    lane = courses(scene)[0].places[:, :2]
    start = np.array(ground.start[:2])
    lane = np.vstack([start, lane[np.linalg.norm(lane - start, axis=1).argmin() + 1 :]])
    along = _arc_length(lane)
    length = along[-1] - ground.car.wheelbase - ground.car.front
    at = np.arange(0.0, length, POINT_SPACING_M)
    middle = np.column_stack([np.interp(at, along, lane[:, axis]) for axis in (0, 1)])
    ahead = np.gradient(middle, axis=0)
    left = np.column_stack([-ahead[:, 1], ahead[:, 0]]) / np.linalg.norm(ahead, axis=1, keepdims=True)
    offset: F64 = middle + left * (LANE_OFFSET_M / 2 * (1 - np.cos(tau * at / at[-1])))[:, None]
    return offset


def _arc_length(points: F64) -> F64:
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


class PurePursuit:
    """Pure pursuit steering along a path."""

    def __init__(self, points: F64, car: Car | None = None) -> None:
        extension = np.arange(1, 41)[:, None] * (points[-1] - points[-2])
        self._points, self._car = np.vstack([points, points[-1] + extension]), car or Car()

    def steering(self, vehicle: VehicleState) -> float:
        """Steering, -1 (full right) to 1 (full left); 0 if the vehicle's position is unknown."""
        if vehicle.position is None or vehicle.heading is None:
            return 0.0
        to = self._points - vehicle.position
        distance = np.hypot(*to.T)
        nearest = int(distance.argmin())
        target = nearest + int(
            (distance[nearest:] >= max(LOOKAHEAD_MIN_M, LOOKAHEAD_S * (vehicle.speed or 0.0))).argmax()
        )
        left = cos(vehicle.heading) * to[target, 1] - sin(vehicle.heading) * to[target, 0]
        turn = atan(self._car.wheelbase * 2 * left / distance[target] ** 2)
        return float(np.clip(turn / self._car.steering, -1.0, 1.0))


class LoopingVehicle(SimulatedVehicle):
    """A simulated car that restarts from its start whenever it has reached the end of the path.

    Attributes:
        positions: number of the drive, x and y, every 0.1 m; runs: number of completed drives.
    """

    def __init__(self, ground: Ground, points: F64, *, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(SimulatedCar(ground), clock=clock)
        self.positions: list[tuple[int, float, float]] = []
        self.runs = 0
        self._ground, self._end = ground, points[-1]

    def obey(self, controls: Controls) -> None:
        """Apply the controls up to the present time."""
        super().obey(controls)
        one = self.car.bicycle
        here = self.runs, one.x, one.y
        last = self.positions[-1] if self.positions else None
        if last is None or last[0] != self.runs or _distance(here, last) >= LOG_SPACING_M:
            self.positions.append(here)
        if hypot(one.x - self._end[0], one.y - self._end[1]) < END_TOLERANCE_M:
            self.runs += 1
            self.car = SimulatedCar(self._ground)

    def begin(self) -> None:
        """Restart, and discard all recorded positions."""
        self.car, self.positions, self.runs = SimulatedCar(self._ground), [], 0


def _distance(one: tuple[int, float, float], other: tuple[int, float, float]) -> float:
    return hypot(one[1] - other[1], one[2] - other[2])


def cross_track_error(points: F64, driven: Sequence[Sequence[float]]) -> F64:
    """Signed distances (N,) of a car from a path (M, 2), metres, positive to the left; `driven`: recorded positions."""
    at = np.array([[x, y] for _, x, y in driven]).reshape(-1, 2)
    nearest = np.linalg.norm(at[:, None] - points[None], axis=2).argmin(axis=1)
    ahead = np.gradient(points, axis=0)[nearest]
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    offset = at - points[nearest]
    left: F64 = ahead[:, 0] * offset[:, 1] - ahead[:, 1] * offset[:, 0]
    return left
