"""A drive along a world's street by script: the way, how it is steered by what comes back, and how far off it was.

The way goes along the longest lane, over to its left and back. The driver steers for a place on it ahead of the car
(pure pursuit: Coulter 1992), and knows of the car what comes back over the links, as late as that is.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import atan, cos, hypot, sin, tau

import numpy as np

from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.io.worlds.scene import Scene
from scan2sim.pipeline.simulation.spawn import courses
from scan2sim.services.teleoperation.control.controls import Controls, VehicleState
from scan2sim.services.teleoperation.sim.bicycle import Car, Ground, SimulatedCar
from scan2sim.services.teleoperation.vehicle.adapters.simulated import SimulatedVehicle

SWAY = 2.5
"""Metres that the way goes over to the left of its lane, in the middle."""
SPACING = 0.25
"""Metres between places of a way."""
AHEAD, LEAST = 0.7, 2.5
"""Seconds, and metres at least, that the place which is steered for is ahead."""
NOTED = 0.1
"""Metres between two places of the car that are noted: each metre counts alike, however fast it was driven."""
END = 1.0
"""Metres before a way's end where it is done."""


def way(scene: Scene, ground: Ground) -> F64:
    """(N, 2) places from where a car starts to the end of its lane, world metres."""
    lane = courses(scene)[0].places[:, :2]
    start = np.array(ground.start[:2])
    lane = np.vstack([start, lane[np.linalg.norm(lane - start, axis=1).argmin() + 1 :]])
    along = _along(lane)
    length = along[-1] - ground.car.wheelbase - ground.car.front
    at = np.arange(0.0, length, SPACING)
    middle = np.column_stack([np.interp(at, along, lane[:, axis]) for axis in (0, 1)])
    ahead = np.gradient(middle, axis=0)
    left = np.column_stack([-ahead[:, 1], ahead[:, 0]]) / np.linalg.norm(ahead, axis=1, keepdims=True)
    aside: F64 = middle + left * (SWAY / 2 * (1 - np.cos(tau * at / at[-1])))[:, None]
    return aside


def _along(places: F64) -> F64:
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))])


class Pursuit:
    """Steers along a way."""

    def __init__(self, places: F64, car: Car | None = None) -> None:
        beyond = np.arange(1, 41)[:, None] * (places[-1] - places[-2])
        self._places, self._car = np.vstack([places, places[-1] + beyond]), car or Car()

    def steering(self, vehicle: VehicleState) -> float:
        """-1 (full right) to 1 (full left), of a vehicle that tells where it is; straight on of one that doesn't."""
        if vehicle.position is None or vehicle.heading is None:
            return 0.0
        to = self._places - vehicle.position
        far = np.hypot(*to.T)
        nearest = int(far.argmin())
        aim = nearest + int((far[nearest:] >= max(LEAST, AHEAD * vehicle.speed)).argmax())
        left = cos(vehicle.heading) * to[aim, 1] - sin(vehicle.heading) * to[aim, 0]
        turn = atan(self._car.wheelbase * 2 * left / far[aim] ** 2)
        return float(np.clip(turn / self._car.steering, -1.0, 1.0))


class Driven(SimulatedVehicle):
    """A car that is put back to where it started whenever it has come to the end of the way.

    Attributes:
        places: number of the drive, x and y, every 0.1 m; runs: drives that came to the end.
    """

    def __init__(self, ground: Ground, places: F64) -> None:
        super().__init__(SimulatedCar(ground))
        self.places: list[tuple[int, float, float]] = []
        self.runs = 0
        self._ground, self._end = ground, places[-1]

    def obey(self, controls: Controls) -> None:
        """Drive until now."""
        super().obey(controls)
        one = self.car.bicycle
        here = self.runs, one.x, one.y
        if not self.places or self.places[-1][0] != self.runs or _apart(here, self.places[-1]) >= NOTED:
            self.places.append(here)
        if hypot(one.x - self._end[0], one.y - self._end[1]) < END:
            self.runs += 1
            self.car = SimulatedCar(self._ground)

    def begin(self) -> None:
        """Begin anew, and forget all."""
        self.car, self.places, self.runs = SimulatedCar(self._ground), [], 0


def _apart(one: tuple[int, float, float], other: tuple[int, float, float]) -> float:
    return hypot(one[1] - other[1], one[2] - other[2])


def aside(places: F64, driven: Sequence[Sequence[float]]) -> F64:
    """(N,) metres to the left of a way (M, 2) that a car was, of places as `Driven` notes them."""
    at = np.array([[x, y] for _, x, y in driven]).reshape(-1, 2)
    nearest = np.linalg.norm(at[:, None] - places[None], axis=2).argmin(axis=1)
    ahead = np.gradient(places, axis=0)[nearest]
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    off = at - places[nearest]
    left: F64 = ahead[:, 0] * off[:, 1] - ahead[:, 1] * off[:, 0]
    return left
