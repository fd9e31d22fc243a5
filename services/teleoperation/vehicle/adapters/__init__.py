"""Vehicle adapters: one module for each kind of vehicle, found by name (`pipeline.core.plugins`).

A new kind of vehicle needs one module: its settings, and an object that applies controls and reports the vehicle's
state. Protocol, watchdog and network are common to all (`vehicle.adapter`).
"""

from __future__ import annotations

from typing import Any, Protocol

from scan2sim.pipeline.core import plugins, step
from scan2sim.services.teleoperation.control.controls import Controls, VehicleState

STATE_MAX_AGE_S = 0.2
"""Age above which a measured speed is unknown, seconds: the driver page covers what is older than 0.3 s, and the state
takes up to 0.1 s from here to the page."""


class VehicleUnreachable(Exception):
    """The vehicle can't be controlled now; the adapter's stop holds until the driver confirms."""


class Vehicle(Protocol):
    """A vehicle, as its adapter controls it; all methods are called in one thread."""

    def obey(self, controls: Controls) -> None:
        """Apply controls, within some milliseconds; called every period, also while the vehicle is stopped.

        Raises:
            VehicleUnreachable: this is impossible now; the next call retries.
        """

    def state(self) -> VehicleState:
        """Last known state; returns at once. A speed measured longer than `STATE_MAX_AGE_S` ago is None."""

    def close(self) -> None:
        """Disconnect; the vehicle was stopped before."""


class VehicleAdapter(Protocol):
    """Interface of an adapter module.

    Attributes:
        Params: settings of the adapter.
    """

    Params: type[step.Params]

    def connect(self, params: Any) -> Vehicle:
        """Connect to the vehicle.

        Raises:
            ScanError: settings or files are wrong; not raised if the vehicle merely isn't available yet.
        """


def names() -> list[str]:
    """Names of all adapters."""
    return plugins.names(__name__)


def find(name: str) -> VehicleAdapter:
    """An adapter that can run here.

    Raises:
        SettingError: there is no adapter of that name.
        UnavailableError: a package that it needs isn't installed.
    """
    found: VehicleAdapter = plugins.find(__name__, name, "adapter")
    return found
