"""A vehicle that records its controls."""

from __future__ import annotations

import time

from scan2sim.services.teleoperation.control.controls import Controls, VehicleState
from scan2sim.services.teleoperation.vehicle.adapters import VehicleUnreachable

TOP_SPEED_M_S = 5.0


class RecordingVehicle:
    """A vehicle that records its controls, with their times.

    Args:
        reported: state that it always reports; None: a speed proportional to the throttle.

    Attributes:
        received: times and controls, the latest last.
        unreachable: if not empty, controls are rejected with this message.
        closed: whether it was closed.
    """

    def __init__(self, reported: VehicleState | None = None) -> None:
        self.received: list[tuple[float, Controls]] = []
        self.unreachable = ""
        self.closed = False
        self._reported = reported

    @property
    def controls(self) -> Controls:
        """The latest controls."""
        return self.received[-1][1] if self.received else Controls()

    def obey(self, controls: Controls) -> None:
        if self.unreachable:
            raise VehicleUnreachable(self.unreachable)
        self.received.append((time.monotonic(), controls))

    def state(self) -> VehicleState:
        return self._reported or VehicleState(TOP_SPEED_M_S * self.controls.throttle, gear=self.controls.gear)

    def close(self) -> None:
        self.closed = True

    def moves(self) -> bool:
        """Whether it drives by its latest controls."""
        return self.controls.throttle > 0
