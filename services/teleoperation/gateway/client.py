"""Connection of a vehicle or station to its gateway: receives orders, and sends the party's status."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from typing import Protocol

from scan2sim.services.supervision import SupervisedThread
from scan2sim.services.teleoperation.control.messages import Malformed
from scan2sim.services.teleoperation.gateway.json_stream import Client, Connection, JsonObject
from scan2sim.services.teleoperation.gateway_protocol import (
    Address,
    DriverEvent,
    DriverRequest,
    Hello,
    Join,
    Release,
    RequestRejected,
    Status,
    from_gateway,
)
from scan2sim.services.teleoperation.identity import Identity

log = logging.getLogger(__name__)

STATUS_PERIOD_S = 0.1
"""Interval between two status messages: the fleet page shows no speed that is older than 0.3 s."""
EVENTS_MAX = 1000
"""Maximum number of events that wait for the gateway; the oldest are dropped."""


class Party(Protocol):
    """Interface of a vehicle or station to its gateway connection."""

    def hello(self) -> Hello:
        """First message to the gateway."""

    def status(self) -> Status:
        """Current status."""

    def handle_order(self, order: Join | Release | RequestRejected) -> None:
        """Carry out an order of the gateway."""


class GatewayConnection:
    """Connects, and reconnects, from creation to `close`; the party's methods are called in its two threads."""

    def __init__(
        self, identity: Identity, gateway: Address, party: Party, notify: Callable[[str], None] = log.warning
    ) -> None:
        """`notify` is called when the gateway is reached, when and why it isn't, and with what it rejects."""
        self._party, self._notify, self._reported_loss = party, notify, ""
        self._where = f"the gateway {gateway.host}:{gateway.port}"
        self._ended = threading.Event()
        self._events: deque[DriverEvent] = deque(maxlen=EVENTS_MAX)
        self._client = Client(
            identity, gateway.host, gateway.port,
            opened=self._opened, received=self._received, closed=self._closed,
        )  # fmt: skip
        self._status_thread = SupervisedThread(self._send_status, "status for the gateway")
        self._status_thread.start()

    def connected(self) -> bool:
        """Whether the gateway is connected."""
        return self._client.connected

    def alive(self) -> bool:
        """Whether its threads are alive."""
        return self._client.is_alive() and self._status_thread.is_alive()

    def send_request(self, request: DriverRequest) -> bool:
        """Send a driver's request to the gateway; False: it isn't connected."""
        return self._client.send(request.wire())

    def report_event(self, event: DriverEvent) -> None:
        """Send an event with the next status; while the gateway isn't connected the latest ones are kept."""
        self._events.append(event)

    def close(self) -> None:
        """Close the connection and end the threads."""
        self._ended.set()
        self._client.close()
        self._status_thread.join(5.0)

    def _opened(self, connection: Connection) -> None:
        self._reported_loss = ""
        self._notify(f"connected to {self._where}")
        connection.send(self._party.hello().wire())

    def _received(self, connection: Connection, data: JsonObject) -> None:
        try:
            order = from_gateway(data)
        except Malformed as error:
            connection.close(f"sent a message that isn't understood ({error}); check that versions match")
        else:
            if isinstance(order, RequestRejected):
                self._notify(f"{self._where} rejected a message: {order.cause}")
            self._party.handle_order(order)

    def _closed(self, reason: str) -> None:
        if reason != self._reported_loss and not self._ended.is_set():
            self._notify(f"{self._where} can't be reached: {reason}")
        self._reported_loss = reason

    def _send_status(self) -> None:
        while not self._ended.wait(STATUS_PERIOD_S):
            while self._events and self._client.send(self._events[0].wire()):
                self._events.popleft()
            self._client.send(self._party.status().wire())
