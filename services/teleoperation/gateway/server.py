"""The gateway server: authenticates vehicles and stations, receives their status, and sends them orders."""

from __future__ import annotations

from collections.abc import Callable

from scan2sim.pipeline.core.errors import ScanError
from scan2sim.services.teleoperation.control.messages import Malformed
from scan2sim.services.teleoperation.gateway.fleet import Fleet, Order
from scan2sim.services.teleoperation.gateway.json_stream import Connection, JsonObject, Server
from scan2sim.services.teleoperation.gateway_protocol import (
    PROTOCOL_VERSION,
    DriverEvent,
    DriverRequest,
    Hello,
    RequestRejected,
    Status,
    to_gateway,
)
from scan2sim.services.teleoperation.identity import Identity

REASON_MAX_CHARS = 200
"""Maximum length of a reason sent to a party."""


class Gateway:
    """Listens from creation to `close`, and passes messages to a `Fleet`."""

    def __init__(self, identity: Identity, host: str, port: int, fleet: Fleet, notify: Callable[[str], None]) -> None:
        """Start listening.

        Args:
            identity: the gateway's own.
            host, port: address to listen on; port 0 for any free one.
            fleet: parties and pairs.
            notify: called with a message when a party connects or disconnects.

        Raises:
            SettingError: it can't listen on this address. BusyError: the port is in use.
        """
        self._fleet, self._notify = fleet, notify
        self._senders: dict[Connection, Callable[[Order], None]] = {}  # of parties that have sent `Hello`
        self._server = Server(
            identity, host, port, opened=lambda connection: None, received=self._received, closed=self._closed
        )
        self.port = self._server.port

    def alive(self) -> bool:
        """Whether its thread is alive."""
        return self._server.is_alive()

    def close(self) -> None:
        """Close all connections; pairs keep driving."""
        self._server.close()

    def _received(self, connection: Connection, data: JsonObject) -> None:
        try:
            message = to_gateway(data)
            if connection in self._senders:
                self._handle(connection, message)
            else:
                self._greet(connection, message)
        except Malformed as error:
            self._reject(connection, f"it sent a message that isn't understood ({error})")

    def _greet(self, connection: Connection, message: Hello | Status | DriverRequest | DriverEvent) -> None:
        if not isinstance(message, Hello) or message.version != PROTOCOL_VERSION:
            self._reject(connection, f"it doesn't support protocol version {PROTOCOL_VERSION}")
            return

        def send(order: Order) -> None:
            connection.send(order.wire())

        self._senders[connection] = send
        self._notify(f"{connection.peer} connected from {connection.address}")
        self._fleet.connected(connection.peer, message, connection.address, send)

    def _handle(self, connection: Connection, message: Hello | Status | DriverRequest | DriverEvent) -> None:
        if isinstance(message, Status):
            self._fleet.update_status(connection.peer, message)
        elif isinstance(message, DriverEvent):
            self._fleet.log_event(connection.peer, message)
        elif isinstance(message, DriverRequest):
            try:
                self._fleet.handle_request(connection.peer, message)
            except ScanError as error:
                connection.send(RequestRejected(cause=str(error)[:REASON_MAX_CHARS]).wire())

    def _reject(self, connection: Connection, reason: str) -> None:
        self._notify(f"{connection.peer} was rejected: {reason}")
        connection.send(RequestRejected(cause=reason[:REASON_MAX_CHARS]).wire())
        connection.close(reason)

    def _closed(self, connection: Connection, reason: str) -> None:
        send = self._senders.pop(connection, None)
        if send is None:
            self._notify(f"{connection.address} was rejected: {reason}")
        else:
            self._notify(f"{connection.peer} disconnected: {reason}")
            self._fleet.disconnected(connection.peer, send)
