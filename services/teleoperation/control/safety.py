"""Safety rules: when a vehicle obeys, when it stops, and how it leaves a stop; without clock, thread or network.

A command is valid if it belongs to the session that drives, is newer than all commands before it, and is not older than
the limit. A vehicle drives on its last valid command until that command is older than the limit; then it stops by
itself. It leaves a stop when the driver confirms it: first by a valid command that names this stop without agreeing
(the driver has seen it, and no button is stuck), then by one that names it and agrees, with the throttle released.
Onboard unit and vehicle adapter apply these rules independently (D3.2, section 4.3).

Times are nanoseconds of the vehicle's monotonic clock; callers convert remote timestamps to it first.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable
from dataclasses import replace

from scan2sim.services.teleoperation.control.controls import STOP, Controls
from scan2sim.services.teleoperation.control.messages import Command

COMMAND_MAX_AGE_MS = 200.0
"""Latency of a mobile link (100 ms and 50 ms of jitter: D3.2, table 6), and two lost commands at fifty per second."""
NS_PER_MS = 10**6
EMERGENCY_STOP = "the emergency stop was pressed"
DROP_OTHER_SESSION, DROP_DUPLICATE, DROP_OUT_OF_ORDER, DROP_TOO_OLD, DROP_FROM_FUTURE = (
    "of another session",
    "double",
    "out of order",
    "old",
    "from the future",
)
"""Reasons for which messages are dropped; keys of `Telemetry.dropped`."""


class SafetyMonitor:
    """Applies the safety rules to each command and at each moment; threads that share it must hold a lock.

    Attributes:
        stop: number of the last stop; each stop has the next number.
        standing: whether the vehicle is still stopped for it; reason: of that stop.
        blocked_by: why the stop can't be left now; "": it can.
        command: number of the last obeyed message, -1: none; age: age of that command when it was obeyed, ms.
        dropped: number of dropped messages, by reason.
    """

    def __init__(self, limit_ms: float = COMMAND_MAX_AGE_MS, first_stop: int = 1) -> None:
        self.limit_ms = limit_ms
        self.stop, self.standing, self.reason, self.blocked_by = first_stop - 1, False, "", ""
        self.command, self.age = -1, 0.0
        self.dropped: Counter[str] = Counter()
        self._session: Hashable | None = None
        self._newest, self._created, self._seen = -1, 0, False
        self._controls = STOP
        self.halt("nobody has driven yet")

    def begin(self, session: Hashable, reason: str = "another driver takes over") -> None:
        """Obey commands of this session only, from now on; the vehicle is stopped until its driver confirms."""
        self._session, self._newest, self.command = session, -1, -1
        self.halt(reason)

    def end(self, reason: str) -> None:
        """Obey no session."""
        self._session = None
        self.halt(reason)

    def halt(self, reason: str) -> None:
        """Stop; a vehicle already stopped for another reason gets a new stop, to be confirmed again."""
        if self.standing and self.reason == reason:
            return
        self.stop += 1
        self.standing, self.reason, self._seen = True, reason, False

    def receive(self, session: Hashable, number: int, command: Command, created: int, now: int) -> bool:
        """Process a command; returns whether it was valid.

        Args:
            session: session that the command was received in.
            number: message number; later messages have larger numbers.
            created: time at which the driver's station created the command.
        """
        self.check(now)  # a late command must not undo the stop that was due
        reason = self._drop_reason(session, number, created, now)
        if reason:
            self.dropped[reason] += 1
            return False
        self._newest, self._created = number, min(created, now)
        if command.emergency:
            self.halt(EMERGENCY_STOP)
        elif self.standing:
            self._confirm(command)
        if not self.standing:
            self._controls, self.command, self.age = command.controls, number, (now - created) / NS_PER_MS
        return True

    def check(self, now: int) -> Controls:
        """Controls to apply now; call this often, since only this notices that commands have stopped."""
        if not self.standing and now - self._created > self.limit_ms * NS_PER_MS:
            self.halt(f"no command younger than {self.limit_ms:g} ms")
        if not self.standing:
            return self._controls
        # brake without straightening the wheels, and keep the lights on
        return replace(STOP, steering=self._controls.steering, lights=self._controls.lights)

    def command_age_ms(self, now: int) -> float:
        """Age of the command that is obeyed now, ms; 0 while the vehicle is stopped."""
        return 0.0 if self.standing else (now - self._created) / NS_PER_MS

    def _drop_reason(self, session: Hashable, number: int, created: int, now: int) -> str:
        if self._session is None or session != self._session:
            return DROP_OTHER_SESSION
        if number <= self._newest:
            return DROP_DUPLICATE if number == self._newest else DROP_OUT_OF_ORDER
        if abs(now - created) > self.limit_ms * NS_PER_MS:
            return DROP_TOO_OLD if created < now else DROP_FROM_FUTURE
        return ""

    def _confirm(self, command: Command) -> None:
        """Leave the stop, if a valid command confirms it."""
        if command.stop != self.stop:
            return
        if not command.agree:
            self._seen = True
        elif self._seen and not self.blocked_by and command.controls.throttle_released():
            self.standing = False
