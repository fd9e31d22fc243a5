"""A vehicle that records its controls, and an onboard unit that a test drives."""

from __future__ import annotations

import atexit
import shutil
import socket
import tempfile
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import cache
from pathlib import Path

from scan2sim.services.teleoperation import adapter_key
from scan2sim.services.teleoperation.control.controls import STOP, Controls, Gear, VehicleState
from scan2sim.services.teleoperation.vehicle.adapter import AdapterServer
from scan2sim.services.teleoperation.vehicle.adapter_protocol import ADAPTER_PERIOD_MS, Answer, OnboardEndpoint
from scan2sim.services.teleoperation.vehicle.adapters import VehicleUnreachable
from tests.fakes.virtual_clock import VirtualClock

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
        clock: clock of the recorded times, seconds.

    Attributes:
        received: times and controls, the latest last.
        unreachable: if not empty, controls are rejected with this message.
        closed: whether it was closed.
    """

    def __init__(self, reported: VehicleState | None = None, *, clock: Callable[[], float] = time.monotonic) -> None:
        self.received: list[tuple[float, Controls]] = []
        self.unreachable = ""
        self.closed = False
        self._reported, self._clock = reported, clock

    @property
    def controls(self) -> Controls:
        """The latest controls."""
        return self.received[-1][1] if self.received else Controls()

    def obey(self, controls: Controls) -> None:
        if self.unreachable:
            raise VehicleUnreachable(self.unreachable)
        self.received.append((self._clock(), controls))

    def state(self) -> VehicleState:
        return self._reported or VehicleState(TOP_SPEED_M_S * self.controls.throttle, gear=self.controls.gear)

    def close(self) -> None:
        self.closed = True

    def moves(self) -> bool:
        """Whether it drives by its latest controls."""
        return self.controls.throttle > 0


class DrivenEndpoint(ABC):
    """An onboard endpoint, driven by the test; `exchange` sends an order and processes answers.

    Attributes:
        driven: whether its driver has confirmed all stops.
    """

    def __init__(self, key: bytes, clock: Callable[[], float] = time.monotonic) -> None:
        self.end, self.key, self.clock, self.driven = OnboardEndpoint(LIMIT_MS), key, clock, False

    @abstractmethod
    def exchange(self, controls: Controls = GO) -> None: ...

    def order(self, controls: Controls) -> bytes:
        """Next order: a stop unless it is driven."""
        now = round(self.clock() * 1e9)
        return self.end.order(controls if self.driven else STOP, 0.0, self.driven, now).pack(self.key)

    def receive(self, packet: bytes) -> None:
        if self.end.receive(Answer.unpack(packet, self.key), round(self.clock() * 1e9)):
            self.driven = False

    def until(self, what: Callable[[], bool], controls: Controls = GO, seconds: float = 60.0) -> None:
        """Exchange until a condition is true."""
        end = self.clock() + seconds
        while not what():
            assert self.clock() < end, self.end.answer
            self.exchange(controls)

    def drive_until(self, what: Callable[[], bool], controls: Controls = GO, seconds: float = 60.0) -> None:
        """Drive until a condition is true; confirms every stop, such as that of a machine that is busy."""

        def driven_and_what() -> bool:
            if not self.driven:
                self.start(what)
            return what()

        self.until(driven_and_what, controls, seconds)

    def start(self, unless: Callable[[], bool] = lambda: False) -> None:
        """Confirm a stop until the adapter has left it; begins again if orders were late, or it has stopped again.

        Args:
            unless: condition under which it may stand.
        """

        def drives() -> bool:
            return self.driven and self.end.answer is not None and not self.end.answer.standing

        self.until(lambda: self.end.answer is not None)
        end = self.clock() + 60
        while not (unless() or drives()):
            assert self.clock() < end, self.end.answer
            self.driven = False
            for _ in range(5):
                self.exchange()
            self.driven = True
            for _ in range(50):
                if not drives() and self.driven:
                    self.exchange()


class OnboardPeer(DrivenEndpoint):
    """An onboard endpoint on the network."""

    def __init__(self, address: tuple[str, int], key: bytes) -> None:
        super().__init__(key)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.connect(address)
        self.socket.settimeout(0.01)

    def exchange(self, controls: Controls = GO) -> None:
        self.socket.send(self.order(controls))
        try:
            while True:
                self.receive(self.socket.recv(2000))
        except (TimeoutError, ConnectionRefusedError):
            pass


class LockstepPeer(DrivenEndpoint):
    """An onboard endpoint and a vehicle adapter in lockstep, in virtual time; `exchange` takes a period."""

    def __init__(self, server: AdapterServer, key: bytes, clock: VirtualClock) -> None:
        super().__init__(key, clock)
        self.server, self.time = server, clock

    def exchange(self, controls: Controls = GO) -> None:
        self.time.sleep(ADAPTER_PERIOD_MS / 1e3)
        if answer := self.server.answer(self.order(controls)):
            self.receive(answer)
        self.server.control()

    def hang(self, seconds: float) -> None:
        """Let the onboard unit hang: the adapter controls the vehicle each period, without orders."""
        for _ in range(round(seconds / ADAPTER_PERIOD_MS * 1e3)):
            self.time.sleep(ADAPTER_PERIOD_MS / 1e3)
            self.server.control()
