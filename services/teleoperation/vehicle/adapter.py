"""A translator at work: orders come by UDP, the vehicle is told every period, and stands where no orders come."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, model_validator

from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.parameters import File
from scan2sim.pipeline.core.step import Params
from scan2sim.services.loopback import require_protection
from scan2sim.services.teleoperation.control.controls import STOP
from scan2sim.services.teleoperation.control.messages import Malformed
from scan2sim.services.teleoperation.control.safety import LIMIT_MS
from scan2sim.services.teleoperation.vehicle.adapter_protocol import LARGEST, PERIOD_MS, PORT, Order, TranslatorEnd
from scan2sim.services.teleoperation.vehicle.adapters import Unreachable, Vehicle

AT_ONCE = 64
"""Packets that are looked at in a period, at most: who floods the translator doesn't keep it from the vehicle."""
SHORTEST_KEY = 16
"""Bytes."""


def read_key(path: Path | None) -> bytes:
    """What car unit and translator both know; b"": they trust their wire.

    Raises:
        InputError: the file can't be read, or is too short.
    """
    if path is None:
        return b""
    try:
        key = path.read_bytes().strip()
    except OSError as error:
        raise InputError(path, str(error.strerror), "Make one for both: openssl rand -hex 32") from None
    if len(key) < SHORTEST_KEY:
        raise InputError(path, f"holds {len(key)} bytes", "Make one for both: openssl rand -hex 32")
    return key


class TranslateParams(Params):
    """Options of every translator.

    Raises:
        SettingError: it would listen beyond the loopback without a key.
    """

    host: Annotated[
        str, Field(description="Address to listen on for the car unit; any but 127.0.0.1 and ::1 needs --key.")
    ] = "127.0.0.1"
    port: Annotated[int, Field(ge=0, le=65535, description="UDP port to listen on; 0 for any that is free.")] = PORT
    key: Annotated[
        File | None, Field(description="File with a key that car unit and translator share; a must off this machine.")
    ] = None
    limit: Annotated[
        float, Field(ge=20, le=5000, description="Milliseconds after which a command is old, and the vehicle stops.")
    ] = LIMIT_MS
    period: Annotated[
        float, Field(ge=1, le=1000, description="Milliseconds from telling the vehicle what to do to the next time.")
    ] = PERIOD_MS

    @model_validator(mode="after")
    def _is_protected(self) -> Self:
        require_protection(self.host, protected=self.key is not None, options="--key FILE")
        return self


class Translating:
    """Listens to a car unit, and tells a vehicle.

    Attributes:
        end: what decides; address: where it listens.
        malformed: packets that were no orders.

    Raises:
        SettingError: it can't listen there.
    """

    def __init__(self, vehicle: Vehicle, params: TranslateParams) -> None:
        self.end = TranslatorEnd(params.limit)
        self.malformed = 0
        self._vehicle, self._period, self._key = vehicle, params.period / 1000, read_key(params.key)
        family = socket.AF_INET6 if ":" in params.host else socket.AF_INET
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        try:
            self._socket.bind((params.host, params.port))
        except OSError as error:
            self._socket.close()
            where = f"{params.host}:{params.port}"
            raise SettingError("--port", f"{where} can't be listened on: {error.strerror}", "Name another") from None
        self.address: tuple[str, int] = self._socket.getsockname()[:2]

    def run(self, ended: threading.Event, say: Callable[[str], None] = lambda _: None) -> None:
        """Work until it is ended; whatever happens, the vehicle is told to stand in the end.

        Args:
            say: is told when the vehicle stops, and why, and when it drives.
        """
        told, due = "", time.monotonic()
        try:
            while not ended.is_set():
                due = max(due + self._period, time.monotonic())
                self._listen(due)
                self._tell()
                safety = self.end.safety
                news = f"stands: {safety.reason}" if safety.standing else "drives"
                if news != told:
                    say(told := news)
        finally:
            with contextlib.suppress(Unreachable):
                self._vehicle.obey(STOP)
            self._vehicle.close()
            self._socket.close()

    def _listen(self, until: float) -> None:
        """Take orders and answer them until the next period begins."""
        for _ in range(AT_ONCE):
            self._socket.settimeout(max(until - time.monotonic(), 0.0001))
            try:
                packet, peer = self._socket.recvfrom(LARGEST + 1)
            except TimeoutError:
                return
            except OSError:  # of an answer before, whom nobody took
                continue
            try:
                order = Order.unpack(packet, self._key)
            except Malformed:
                self.malformed += 1
                continue
            self.end.hear(order, time.monotonic_ns())
            answer = self.end.answer(self._vehicle.state(), time.monotonic_ns())
            with contextlib.suppress(OSError):  # the car unit is gone: it is silent soon
                self._socket.sendto(answer.pack(self._key), peer)
        time.sleep(max(until - time.monotonic(), 0))

    def _tell(self) -> None:
        """Tell the vehicle; what can't be told is a stop, and the answers say so."""
        safety = self.end.safety
        try:
            self._vehicle.obey(self.end.check(time.monotonic_ns()))
        except Unreachable as error:
            safety.hindrance = str(error)
            safety.halt(str(error))
        else:
            safety.hindrance = ""
