"""The wheel: who drives at a station, and what he asks for now.

A page that has the wheel says so again and again. Where it falls silent - its tab is in the background, the gamepad is
unplugged, the browser hangs - nothing is sent any more, and the vehicle stops.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass

from scan2sim.pipeline.core.errors import BusyError
from scan2sim.services.teleoperation.control.messages import Command

FRESH = 0.2
"""Seconds for which what a driver asked is sent on."""
HELD = 5.0
"""Seconds of silence after which another may take the wheel."""


@dataclass
class _Driver:
    name: str
    command: Command | None
    heard: float


class Wheel:
    """Times are seconds of any clock that only goes forward; methods may be called from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._driver: _Driver | None = None
        self.told = ""
        """Why nobody has the wheel any more."""

    def take(self, who: str, now: float) -> None:
        """Have the wheel from now on.

        Raises:
            BusyError: somebody else has it.
        """
        with self._lock:
            holds = self._driver
            if holds is not None and holds.name != who and now - holds.heard < HELD:
                raise BusyError("the wheel", "is held on another page", "Leave it there first")
            self._driver, self.told = _Driver(who, None, now), ""

    def turn(self, who: str, command: Command, now: float) -> bool:
        """What who has the wheel asks for; False: he hasn't."""
        with self._lock:
            if self._driver is None or self._driver.name != who:
                return False
            self._driver.command, self._driver.heard = command, now
            return True

    def leave(self, who: str, why: str) -> None:
        """Let go of it, if he has it."""
        with self._lock:
            if self._driver is not None and self._driver.name == who:
                self._driver, self.told = None, why

    def held_by(self) -> str | None:
        """Who has it."""
        with self._lock:
            return None if self._driver is None else self._driver.name

    def command(self, now: float) -> Command | None:
        """What is asked for now; None: nothing that is fresh."""
        with self._lock:
            driver = self._driver
            if driver is None or driver.command is None or now - driver.heard > FRESH:
                return None
            return driver.command
