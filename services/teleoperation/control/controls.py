"""Controls of a driver and state of a vehicle, the same for every kind of vehicle."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum


class Gear(IntEnum):
    """Direction in which the throttle drives."""

    REVERSE = -1
    NEUTRAL = 0
    FORWARD = 1


@dataclass(frozen=True)
class Controls:
    """Controls of the driver at one moment.

    Attributes:
        steering: -1 (full right) to 1 (full left), the sign of angles about z.
        throttle, brake: 0 to 1.
        gear, horn, lights: requested gear; whether horn and lights are on.
    """

    steering: float = 0.0
    throttle: float = 0.0
    brake: float = 0.0
    gear: Gear = Gear.NEUTRAL
    horn: bool = False
    lights: bool = False

    def throttle_released(self) -> bool:
        """Whether the throttle is zero."""
        return self.throttle == 0.0


STOP = Controls(brake=1.0)
"""Full brake, no throttle, neutral gear."""


@dataclass(frozen=True)
class VehicleState:
    """State of a vehicle, as the vehicle reports it.

    Attributes:
        speed: m/s along its x axis, negative backwards; None: unknown.
        position: (x, y) metres east and north of an origin of its own, or of its world; None: unknown.
        heading: radians from east, anticlockwise; None: unknown.
        gear: engaged gear.
        faults: messages for the driver; empty: none.
    """

    speed: float | None = 0.0
    position: tuple[float, float] | None = None
    heading: float | None = None
    gear: Gear = Gear.NEUTRAL
    faults: tuple[str, ...] = ()
