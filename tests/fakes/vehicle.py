"""A vehicle that records its controls, and an onboard unit that a test drives."""

from __future__ import annotations

import atexit
import shutil
import socket
import tempfile
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path

from scan2sim.services.teleoperation import adapter_key
from scan2sim.services.teleoperation.control.controls import STOP, Controls, Gear, VehicleState
from scan2sim.services.teleoperation.vehicle.adapter_protocol import Answer, OnboardEndpoint
from scan2sim.services.teleoperation.vehicle.adapters import VehicleUnreachable

TOP_SPEED_M_S = 5.0
LIMIT_MS = 200.0
GO = Controls(0.5, throttle=1.0, gear=Gear.FORWARD, lights=True)


@cache
def adapter_key_file() -> Path:
    """Key shared by the onboard units and adapters of a test run."""
    folder = Path(tempfile.mkdtemp(prefix="adapter-key-"))
    atexit.register(shutil.rmtree, folder)
    return adapter_key.create(folder / adapter_key.ADAPTER_KEY_FILE)


class RecordingVehicle:
    """A vehicle that records its controls, with their times.

    Args:
        reported: state that it always reports; None: a speed proportional to the throttle.

    Attributes:
        received: times and controls, the latest last.
        unreachable: if not empty, controls are rejected with this message.
        closed: whether it was closed.
    """

    def __init__(self, reported: VehicleState | None = None) -> None:
        self.received: list[tuple[float, Controls]] = []
        self.unreachable = ""
        self.closed = False
        self._reported = reported

    @property
    def controls(self) -> Controls:
        """The latest controls."""
        return self.received[-1][1] if self.received else Controls()

    def obey(self, controls: Controls) -> None:
        if self.unreachable:
            raise VehicleUnreachable(self.unreachable)
        self.received.append((time.monotonic(), controls))

    def state(self) -> VehicleState:
        return self._reported or VehicleState(TOP_SPEED_M_S * self.controls.throttle, gear=self.controls.gear)

    def close(self) -> None:
        self.closed = True

    def moves(self) -> bool:
        """Whether it drives by its latest controls."""
        return self.controls.throttle > 0


class OnboardPeer:
    """A running onboard endpoint, driven by the test; `exchange` sends an order and processes answers."""

    def __init__(self, address: tuple[str, int], key: bytes) -> None:
        self.end, self.key, self.driven = OnboardEndpoint(LIMIT_MS), key, False
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.connect(address)
        self.socket.settimeout(0.01)

    def exchange(self, controls: Controls = GO) -> None:
        order = self.end.order(controls if self.driven else STOP, 0.0, self.driven, time.monotonic_ns())
        self.socket.send(order.pack(self.key))
        try:
            while True:
                answer = Answer.unpack(self.socket.recv(2000), self.key)
                if self.end.receive(answer, time.monotonic_ns()):
                    self.driven = False
        except (TimeoutError, ConnectionRefusedError):
            pass

    def until(self, what: Callable[[], bool], controls: Controls = GO, seconds: float = 20.0) -> None:
        end = time.monotonic() + seconds
        while not what():
            assert time.monotonic() < end, self.end.answer
            self.exchange(controls)

    def start(self) -> None:
        self.until(lambda: self.end.answer is not None)
        for _ in range(5):
            self.exchange()
        self.driven = True
        self.until(lambda: self.end.answer is not None and not self.end.answer.standing)
