"""A driver at a station, as an onboard unit sees them: a connection that records, and commands at a fixed rate."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from scan2sim.services.teleoperation.control.controls import Controls, Gear
from scan2sim.services.teleoperation.control.messages import Command, Kind, Message, Telemetry
from scan2sim.services.teleoperation.control.safety import NS_PER_MS
from tests.waiting import until

GO = Controls(0.5, throttle=1.0, gear=Gear.FORWARD)
REST = Controls(gear=Gear.FORWARD)


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
        return next(Telemetry.unpack(body) for kind, body in reversed(self.sent) if kind == Kind.TELEMETRY)


class ScriptedDriver:
    """A running driver, who sends fifty commands per second."""

    def __init__(self, connection: FakeConnection, received: Callable[[Message], None]) -> None:
        self.connection, self.received = connection, received
        self.controls, self.agree, self.number, self.ended = REST, False, 0, threading.Event()
        self.thread = threading.Thread(target=self.run)
        self.thread.start()

    def run(self) -> None:
        while not self.ended.wait(0.02):
            sent = any(kind == Kind.TELEMETRY for kind, _ in self.connection.sent)
            telemetry = self.connection.telemetry() if sent else None
            self.number += 1
            command = Command(self.controls, telemetry.stop if telemetry else 0, self.agree)
            self.received(Message(Kind.COMMAND, self.number, time.monotonic_ns(), command.pack()))

    def until(self, condition: Callable[[], bool]) -> None:
        until(condition, 20, state=self.connection.telemetry)

    def start(self) -> None:
        """Release the throttle, press the confirm button until the vehicle drives, press the throttle."""
        self.controls, self.agree = REST, False
        time.sleep(0.15)
        self.agree = True
        self.until(lambda: not self.connection.telemetry().standing)
        self.controls, self.agree = GO, False
