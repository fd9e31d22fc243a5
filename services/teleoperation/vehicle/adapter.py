"""Server of a vehicle adapter: receives orders over UDP, controls the vehicle each period, stops it without orders."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable
from typing import Annotated, Self

from pydantic import Field, model_validator

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.parameters import File
from scan2sim.pipeline.core.step import Params
from scan2sim.services.teleoperation import adapter_key
from scan2sim.services.teleoperation.control.controls import STOP
from scan2sim.services.teleoperation.control.messages import Malformed
from scan2sim.services.teleoperation.control.safety import COMMAND_MAX_AGE_MS
from scan2sim.services.teleoperation.settings import ADAPTER_PORT
from scan2sim.services.teleoperation.vehicle.adapter_protocol import (
    ADAPTER_PERIOD_MS,
    PACKET_MAX_BYTES,
    AdapterEndpoint,
    Order,
)
from scan2sim.services.teleoperation.vehicle.adapters import Vehicle, VehicleUnreachable

PACKETS_PER_PERIOD_MAX = 64
"""Maximum number of packets processed in a period, so that a flood can't delay the vehicle's control."""


class AdapterParams(Params):
    """Settings common to all vehicle adapters.

    Raises:
        SettingError: there is no key.
    """

    host: Annotated[
        str,
        Field(
            description="Address to listen on for the onboard unit; others than 127.0.0.1 for one on another machine."
        ),
    ] = "127.0.0.1"
    port: Annotated[int, Field(ge=0, le=65535, description="UDP port to listen on; 0: any free port.")] = ADAPTER_PORT
    key: Annotated[
        File | None,
        Field(
            description="File with the key shared with the onboard unit, DIR/vehicle-NAME/adapter.key of `teleop "
            "certificates`; required: only orders signed with it are obeyed."
        ),
    ] = None
    limit: Annotated[
        float,
        Field(
            ge=20, le=5000, description="Maximum age of a command, milliseconds; without a newer one the vehicle stops."
        ),
    ] = COMMAND_MAX_AGE_MS
    period: Annotated[
        float, Field(ge=1, le=1000, description="Interval at which controls are sent to the vehicle, milliseconds.")
    ] = ADAPTER_PERIOD_MS

    @model_validator(mode="after")
    def _is_protected(self) -> Self:
        adapter_key.require(self.key)
        return self


class AdapterServer:
    """Receives orders of an onboard unit, and controls a vehicle.

    `run` has the loop and the network around `answer` and `control`.

    Attributes:
        endpoint: decides which orders are obeyed; address: where it listens.
        malformed: number of packets that were not orders.

    Raises:
        SettingError: it can't listen on this address.
        InputError: the key can't be read.
    """

    def __init__(
        self, vehicle: Vehicle, params: AdapterParams, *, clock: Callable[[], int] = time.monotonic_ns
    ) -> None:
        """`clock`: monotonic clock, nanoseconds."""
        self.endpoint, self._clock = AdapterEndpoint(params.limit), clock
        self.malformed = 0
        self._vehicle, self._period, self._key = vehicle, params.period / 1000, adapter_key.read(params.key)
        family = socket.AF_INET6 if ":" in params.host else socket.AF_INET
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        try:
            self._socket.bind((params.host, params.port))
        except OSError as error:
            self._socket.close()
            cause = f"can't listen on {params.host}:{params.port}: {error.strerror}"
            raise SettingError("--port", cause, "Choose another host or port") from None
        self.address: tuple[str, int] = self._socket.getsockname()[:2]

    def run(self, ended: threading.Event, notify: Callable[[str], None] = lambda _: None) -> None:
        """Run until `ended` is set; stops the vehicle at the end, whatever happens.

        Args:
            notify: called when the vehicle stops, with the reason, and when it drives.
        """
        reported, due = "", time.monotonic()
        try:
            while not ended.is_set():
                due = max(due + self._period, time.monotonic())
                self._listen(due)
                self.control()
                safety = self.endpoint.safety
                state = f"is stopped: {safety.reason}" if safety.standing else "drives"
                if state != reported:
                    notify(reported := state)
        finally:
            with contextlib.suppress(VehicleUnreachable):
                self._vehicle.obey(STOP)
            self._vehicle.close()
            self._socket.close()

    def answer(self, packet: bytes) -> bytes | None:
        """Process a received packet; returns the answer, None if it is not an order."""
        try:
            order = Order.unpack(packet, self._key)
        except Malformed:
            self.malformed += 1
            return None
        self.endpoint.receive(order, self._clock())
        return self.endpoint.answer(self._vehicle.state(), self._clock()).pack(self._key)

    def control(self) -> None:
        """Send controls to the vehicle; if it is unreachable this is a stop, which the answers report."""
        safety = self.endpoint.safety
        try:
            self._vehicle.obey(self.endpoint.check(self._clock()))
        except VehicleUnreachable as error:
            safety.blocked_by = str(error)
            safety.halt(str(error))
        else:
            safety.blocked_by = ""

    def _listen(self, until: float) -> None:
        """Receive orders and answer them until the next period begins."""
        for _ in range(PACKETS_PER_PERIOD_MAX):
            self._socket.settimeout(max(until - time.monotonic(), 0.0001))
            try:
                packet, peer = self._socket.recvfrom(PACKET_MAX_BYTES + 1)
            except TimeoutError:
                return
            except OSError:  # ICMP error after an earlier answer
                continue
            if answer := self.answer(packet):
                with contextlib.suppress(OSError):  # the onboard unit is gone; its orders time out
                    self._socket.sendto(answer, peer)
        time.sleep(max(until - time.monotonic(), 0))
