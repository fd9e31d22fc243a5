"""A driver at a station, as an onboard unit sees them: a connection that records, and commands at a fixed rate."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from scan2sim.services.teleoperation.control.controls import Controls, Gear
from scan2sim.services.teleoperation.control.messages import Command, Kind, Message, Telemetry
from scan2sim.services.teleoperation.control.safety import NS_PER_MS
from tests.waiting import until

GO = Controls(0.5, throttle=1.0, gear=Gear.FORWARD)
REST = Controls(gear=Gear.FORWARD)
COMMAND_PERIOD_S = 0.02
SIGHTINGS = 8
"""Commands that name a stop before the driver agrees."""


@dataclass
class FakeClocks:
    """Clocks of a station that equal those of the vehicle."""

    known: bool = True
    uncertainty_ms: float = 5.0
    wall_apart_s: float = 0.0
    now: Callable[[], int] = time.monotonic_ns

    @property
    def wall_wrong(self) -> bool:
        return abs(self.wall_apart_s) > 1

    def age_ms(self, sent: int) -> float:
        return (self.now() - sent) / NS_PER_MS if self.known else math.inf


@dataclass
class FakeConnection:
    clocks: FakeClocks = field(default_factory=FakeClocks)
    sent: list[tuple[Kind, bytes]] = field(default_factory=list)
    closed: bool = False

    def send(self, kind: Kind, body: bytes) -> int:
        self.sent.append((kind, body))
        return len(self.sent)

    def close(self) -> None:
        self.closed = True

    def telemetry(self) -> Telemetry:
        """The latest."""
        return next(Telemetry.unpack(body) for kind, body in reversed(self.sent) if kind == Kind.TELEMETRY)

    def has_telemetry(self) -> bool:
        return any(kind == Kind.TELEMETRY for kind, _ in self.sent)


class ScriptedDriver:
    """A driver, who holds the throttle; `step` sends a command.

    Attributes:
        confirms: whether the driver confirms stops, with the throttle released; else it is held while standing, too.
    """

    def __init__(
        self,
        connection: FakeConnection,
        received: Callable[[Message], None],
        *,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.connection, self.received, self.confirms = connection, received, True
        self._clock, self._number, self._stop, self._sightings = clock, 0, 0, 0

    def step(self) -> None:
        telemetry = self.connection.telemetry() if self.connection.has_telemetry() else None
        command = Command(GO, telemetry.stop if telemetry else 0)
        if self.confirms and (telemetry is None or telemetry.standing):
            if self._stop != command.stop:
                self._stop, self._sightings = command.stop, 0
            # sees the stop, then agrees; again and again, since commands may arrive too late
            command = replace(command, controls=REST, agree=self._sightings % (2 * SIGHTINGS) >= SIGHTINGS)
            self._sightings += 1
        self._number += 1
        self.received(Message(Kind.COMMAND, self._number, self._clock(), command.pack()))


class RunningDriver(ScriptedDriver):
    """A driver in a thread, who sends fifty commands per second until `end`."""

    def __init__(self, connection: FakeConnection, received: Callable[[Message], None]) -> None:
        super().__init__(connection, received)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def end(self) -> None:
        self._ended.set()
        self._thread.join()

    def until(self, condition: Callable[[], bool]) -> None:
        until(condition, state=self.connection.telemetry)

    def _run(self) -> None:
        while not self._ended.wait(COMMAND_PERIOD_S):
            self.step()
