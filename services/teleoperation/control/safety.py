"""When a vehicle obeys, when it stands, and how it leaves a stop: the rules, without clock, thread or network.

A command is good if it is of the session that drives, newer than all before it, and not older than the limit. A vehicle
drives on its last good command, never for longer than the limit after that one was made; then it stops by itself. It
leaves a stop when the driver confirms it: a good command that names that stop and doesn't agree (the driver has seen
it, and no button is stuck), then one that names it and agrees, with the throttle at rest. Car unit and translator, each
for itself, go by these rules (D3.2, section 4.3).

Times are nanoseconds of one monotonic clock, the vehicle's own; who knows another's clock has brought them to it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable
from dataclasses import replace

from scan2sim.services.teleoperation.control.controls import STOP, Controls
from scan2sim.services.teleoperation.control.messages import Command

LIMIT_MS = 200.0
"""What a mobile link may take (100 ms, and 50 ms of jitter: D3.2, table 6), and two commands of fifty a second lost."""
MS = 10**6
"""Nanoseconds."""
OTHER, DOUBLE, LATE, OLD, FUTURE = "of another session", "double", "out of order", "old", "from the future"
"""Why messages are dropped."""


class Safety:
    """Decides, command by command and moment by moment; whoever calls it from several threads holds a lock.

    Attributes:
        stop: number of the last stop; each is one more than the one before.
        standing: whether the vehicle stands for it still; reason: why.
        hindrance: why a stop can't be left now; "": it can.
        command: number of the last message that was obeyed, -1: none; age: its milliseconds when it was.
        dropped: messages that were not good, by why.
    """

    def __init__(self, limit_ms: float = LIMIT_MS, first_stop: int = 1) -> None:
        self.limit_ms = limit_ms
        self.stop, self.standing, self.reason, self.hindrance = first_stop - 1, False, "", ""
        self.command, self.age = -1, 0.0
        self.dropped: Counter[str] = Counter()
        self._session: Hashable | None = None
        self._newest, self._made, self._seen = -1, 0, False
        self._controls = STOP
        self.halt("nobody has driven yet")

    def begin(self, session: Hashable, reason: str = "another driver takes over") -> None:
        """Obey this session's commands from now on, and no other's; the vehicle stands until its driver confirms."""
        self._session, self._newest, self.command = session, -1, -1
        self.halt(reason)

    def end(self, reason: str) -> None:
        """Obey nobody."""
        self._session = None
        self.halt(reason)

    def halt(self, reason: str) -> None:
        """Stop; a vehicle that stands for another reason has a new stop to be confirmed."""
        if self.standing and self.reason == reason:
            return
        self.stop += 1
        self.standing, self.reason, self._seen = True, reason, False

    def hear(self, session: Hashable, number: int, command: Command, made: int, now: int) -> bool:
        """Take a command, and say whether it was good.

        Args:
            session: that it came by.
            number: of its message; later ones have larger numbers.
            made: when the driver's station made it.
        """
        self.check(now)  # what comes after too long a silence doesn't undo the stop that was due
        why = self._why_not(session, number, made, now)
        if why:
            self.dropped[why] += 1
            return False
        self._newest, self._made = number, min(made, now)
        if self.standing:
            self._leave(command)
        if not self.standing:
            self._controls, self.command, self.age = command.controls, number, (now - made) / MS
        return True

    def check(self, now: int) -> Controls:
        """What the vehicle is to do now; asked often, as nothing else notices that commands no longer come."""
        if not self.standing and now - self._made > self.limit_ms * MS:
            self.halt(f"no command younger than {self.limit_ms:g} ms")
        if not self.standing:
            return self._controls
        # it brakes in the bend that it was in, and stays seen
        return replace(STOP, steering=self._controls.steering, lights=self._controls.lights)

    def old(self, now: int) -> float:
        """Milliseconds since the command was made that is obeyed now; 0 while it stands."""
        return 0.0 if self.standing else (now - self._made) / MS

    def _why_not(self, session: Hashable, number: int, made: int, now: int) -> str:
        if self._session is None or session != self._session:
            return OTHER
        if number <= self._newest:
            return DOUBLE if number == self._newest else LATE
        if abs(now - made) > self.limit_ms * MS:
            return OLD if made < now else FUTURE
        return ""

    def _leave(self, command: Command) -> None:
        """Leave the stop, if a good command confirms it."""
        if command.stop != self.stop:
            return
        if not command.agree:
            self._seen = True
        elif self._seen and not self.hindrance and command.controls.at_rest():
            self.standing = False
