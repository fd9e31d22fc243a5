"""The driver session: the control lock of a station (which page drives), that page's latest command, emergency stops.

The page that holds the lock sends its controls repeatedly. When it falls silent (its tab is in the background, the
gamepad is unplugged, the browser hangs), no commands are sent any more, and the vehicle stops.

Any page can latch an emergency stop, whoever drives: it replaces all commands until it is released deliberately.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass

from scan2sim.pipeline.core.errors import BusyError
from scan2sim.services.teleoperation.control.controls import STOP
from scan2sim.services.teleoperation.control.messages import Command

COMMAND_TIMEOUT_S = 0.2
"""Maximum age of a driver's command; an older one is not sent."""
EMERGENCY = Command(STOP, emergency=True)
"""Command that is sent while an emergency stop is latched."""
LOCK_TIMEOUT_S = 5.0
"""Silence of the driver's page after which another page may acquire the lock."""


@dataclass
class _Driver:
    name: str
    command: Command | None
    last_heard: float
    acquired: float


class DriverSession:
    """Control lock and latest command. Times are seconds of any monotonic clock; methods are thread-safe.

    Args:
        notify: called with what a driver did and the driver's name, in the driver's thread; must not block.
    """

    def __init__(self, notify: Callable[[str, str], None] = lambda what, driver: None) -> None:
        self._notify = notify
        self._lock = threading.Lock()
        self._driver: _Driver | None = None
        self.release_reason = ""
        """Why the last driver lost the lock; empty while somebody holds it."""
        self.latched = ""
        """Who pressed the emergency stop that is latched; empty: none is."""

    def acquire(self, driver: str, now: float) -> None:
        """Acquire the control lock.

        Raises:
            BusyError: another driver holds it.
        """
        with self._lock:
            holder = self._driver
            if holder is not None and holder.name != driver and now - holder.last_heard < LOCK_TIMEOUT_S:
                raise BusyError("the controls", "are in use on another page", "Release them there first")
            acquired = holder.acquired if holder is not None and holder.name == driver else now
            self._driver, self.release_reason = _Driver(driver, None, now, acquired), ""
        if holder is None or holder.name != driver:
            self._notify("take control", driver)

    def update(self, driver: str, command: Command, now: float) -> bool:
        """Set the latest command; False: this driver does not hold the lock."""
        with self._lock:
            if self._driver is None or self._driver.name != driver:
                return False
            before, self._driver.command, self._driver.last_heard = self._driver.command, command, now
        if command.agree and not (before is not None and before.agree):
            self._notify(f"confirm stop {command.stop}", driver)
        return True

    def release(self, driver: str, reason: str) -> None:
        """Release the lock, if this driver holds it."""
        with self._lock:
            if self._driver is None or self._driver.name != driver:
                return
            self._driver, self.release_reason = None, reason
        self._notify(f"release control: {reason}", driver)

    def latch(self, by: str) -> None:
        """Latch an emergency stop; `by`: who pressed it."""
        with self._lock:
            if self.latched:
                return
            self.latched = by
        self._notify("press emergency stop", by)

    def unlatch(self, driver: str) -> None:
        """End an emergency stop; the vehicle still waits for a confirmation.

        Raises:
            BusyError: another driver holds the control lock, who alone may end it.
        """
        with self._lock:
            if self._driver is not None and self._driver.name != driver:
                raise BusyError("the emergency stop", "can be ended by the driver only", "End it on the driver's page")
            was, self.latched = self.latched, ""
        if was:
            self._notify("end emergency stop", driver)

    def holder(self) -> str | None:
        """Name of the driver who holds the lock; None: nobody."""
        with self._lock:
            return None if self._driver is None else self._driver.name

    def held(self, now: float) -> tuple[str, float]:
        """Name of the driver who holds the lock, and for how many seconds; "" and 0: nobody."""
        with self._lock:
            return ("", 0.0) if self._driver is None else (self._driver.name, now - self._driver.acquired)

    def command(self, now: float) -> Command | None:
        """The command to send now; None: there is none within `COMMAND_TIMEOUT_S`."""
        with self._lock:
            if self.latched:
                return EMERGENCY
            driver = self._driver
            if driver is None or driver.command is None or now - driver.last_heard > COMMAND_TIMEOUT_S:
                return None
            return driver.command
