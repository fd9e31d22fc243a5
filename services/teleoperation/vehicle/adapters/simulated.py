"""A simulated car in a world created by this project (`services.teleoperation.sim.bicycle`)."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Annotated

from pydantic import Field

from scan2sim.pipeline.core import step
from scan2sim.pipeline.core.parameters import File
from scan2sim.pipeline.io.worlds.scene import read_scene
from scan2sim.services.teleoperation.control.controls import Controls, VehicleState
from scan2sim.services.teleoperation.sim.bicycle import Ground, SimulatedCar
from scan2sim.services.teleoperation.vehicle.adapters import Vehicle


class Params(step.Params):
    """Settings of a simulated car."""

    world: Annotated[File, Field(description="Folder of a finished world, written by `run --out` or `survey --out`.")]


def connect(params: Params) -> Vehicle:
    """See `adapters.VehicleAdapter`."""
    return SimulatedVehicle(SimulatedCar(Ground(read_scene(params.world))))


class SimulatedVehicle:
    """See `adapters.Vehicle`; simulated time follows real time between calls."""

    def __init__(self, car: SimulatedCar, *, clock: Callable[[], float] = time.monotonic) -> None:
        self.car, self._clock = car, clock
        self._last = clock()

    def obey(self, controls: Controls) -> None:
        """Apply the controls up to the present time."""
        now = self._clock()
        self.car.advance(controls, min(now - self._last, 1.0))
        self._last = now

    def state(self) -> VehicleState:
        """Current state."""
        return self.car.state()

    def close(self) -> None:
        """Nothing to close."""
