"""What a driver asks of a vehicle, and what the vehicle tells of itself: the same for every vehicle."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum


class Gear(IntEnum):
    """Which way the throttle drives."""

    REVERSE = -1
    NEUTRAL = 0
    FORWARD = 1


@dataclass(frozen=True)
class Controls:
    """What a driver asks for at one moment.

    Attributes:
        steering: -1 (full right) to 1 (full left), as angles about z are counted.
        throttle, brake: 0 to 1.
        gear, horn, lights: see their names.
    """

    steering: float = 0.0
    throttle: float = 0.0
    brake: float = 0.0
    gear: Gear = Gear.NEUTRAL
    horn: bool = False
    lights: bool = False

    def at_rest(self) -> bool:
        """Whether nothing is asked that would move the vehicle."""
        return self.throttle == 0.0


STOP = Controls(brake=1.0)
"""Stand, and stay so."""


@dataclass(frozen=True)
class VehicleState:
    """What a vehicle tells of itself.

    Attributes:
        speed: metres a second along its x axis, negative backwards.
        position: (x, y) metres east and north of a place of its own, or of its world; None: unknown.
        heading: radians from east, anticlockwise; None: unknown.
        gear: that is in.
        faults: what isn't well, in words; nothing: all is.
    """

    speed: float = 0.0
    position: tuple[float, float] | None = None
    heading: float | None = None
    gear: Gear = Gear.NEUTRAL
    faults: tuple[str, ...] = ()
