"""A car simulated in a world that this project made (`services.teleoperation.sim.bicycle`)."""

from __future__ import annotations

import time
from typing import Annotated

from pydantic import Field

from scan2sim.pipeline.core import step
from scan2sim.pipeline.core.parameters import File
from scan2sim.pipeline.io.worlds.scene import read_scene
from scan2sim.services.teleoperation.control.controls import Controls, VehicleState
from scan2sim.services.teleoperation.sim.bicycle import Ground, SimulatedCar
from scan2sim.services.teleoperation.vehicle.adapters import Vehicle


class Params(step.Params):
    """Of a car that is simulated."""

    world: Annotated[File, Field(description="Folder that was given to `run` or `survey` by --out.")]


def connect(params: Params) -> Vehicle:
    """See `translators.Translator`."""
    return SimulatedVehicle(SimulatedCar(Ground(read_scene(params.world))))


class SimulatedVehicle:
    """See `translators.Vehicle`; time goes on between calls."""

    def __init__(self, car: SimulatedCar) -> None:
        self.car = car
        self._last = time.monotonic()

    def obey(self, controls: Controls) -> None:
        """Drive until now."""
        now = time.monotonic()
        self.car.go(controls, min(now - self._last, 1.0))
        self._last = now

    def state(self) -> VehicleState:
        """Where it is."""
        return self.car.state()

    def close(self) -> None:
        """Nothing is open."""
