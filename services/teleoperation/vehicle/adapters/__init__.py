"""Translators: how each kind of vehicle is told what to do; a file each, found by its name (`pipeline.core.plugins`).

A new vehicle costs one file: its settings, and an object that takes controls and tells of the vehicle. The protocol of
the car unit, the watchdog and the network are `translating`'s, the same for all.
"""

from __future__ import annotations

from typing import Any, Protocol

from scan2sim.pipeline.core import plugins, step
from scan2sim.services.teleoperation.control.controls import Controls, VehicleState


class Unreachable(Exception):
    """The vehicle can't be told anything now: it stands by the translator's stop until the driver confirms."""


class Vehicle(Protocol):
    """A vehicle, as its translator reaches it; all is called in one thread."""

    def obey(self, controls: Controls) -> None:
        """Tell it what to do, within some milliseconds; called every period, also while it stands.

        Raises:
            Unreachable: that is impossible now; it is tried again at the next call.
        """

    def state(self) -> VehicleState:
        """How it is, as far as that is known; returns at once."""

    def close(self) -> None:
        """Leave it; it was told to stand before."""


class Translator(Protocol):
    """What a file here has.

    Attributes:
        Params: its settings.
    """

    Params: type[step.Params]

    def connect(self, params: Any) -> Vehicle:
        """Reach the vehicle.

        Raises:
            ScanError: its settings or files are wrong; not where the vehicle merely isn't there yet.
        """


def names() -> list[str]:
    """Of all translators."""
    return plugins.names(__name__)


def find(name: str) -> Translator:
    """A translator that can run here.

    Raises:
        SettingError: there is none of that name.
        UnavailableError: a package that it needs isn't installed.
    """
    found: Translator = plugins.find(__name__, name, "translator")
    return found
