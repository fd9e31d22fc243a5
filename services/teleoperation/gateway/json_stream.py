"""JSON lines over TLS between the gateway and vehicles and stations, for all messages except driving.

One thread serves all connections of a `Server`; a `Client` has its own, and reconnects when its connection breaks.
Callbacks run in that thread, one at a time, and must not block. A blank line is a heartbeat.

TLS is pyOpenSSL's (`transport.tls`): Python's `ssl`, on which WebSocket libraries build, can't set the ciphers of
TLS 1.3 and the key exchange groups before Python 3.15, so D3.2's order of ciphers and X25519MLKEM768 would be lost.
"""

from __future__ import annotations

import json
import logging
import selectors
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

from scan2sim.pipeline.core.errors import BusyError, SettingError
from scan2sim.services.teleoperation.identity import Identity, Peer, Role
from scan2sim.services.teleoperation.transport import tls
from scan2sim.services.teleoperation.transport.tls import Channel, TlsClosed, TlsError

log = logging.getLogger(__name__)

LINE_MAX_BYTES = 2**16
"""Maximum length of a line."""
SEND_QUEUE_MAX_BYTES = 2**20
"""Maximum number of bytes queued for a slow reader, which is disconnected then."""
CONNECTIONS_MAX, HANDSHAKES_MAX = 256, 64
"""Maximum number of connections, and of those among them whose handshake isn't complete."""
HEARTBEAT_S, IDLE_TIMEOUT_S, HANDSHAKE_TIMEOUT_S = 2.0, 8.0, 5.0
"""Interval of heartbeats; silence after which a connection is closed; time allowed for a handshake."""
RECONNECT_DELAYS_S = (0.25, 5.0)
"""Delay before a client reconnects: initial and maximum; it doubles with each attempt."""

JsonObject = dict[str, Any]


class Connection:
    """A connection of the gateway with a vehicle or station.

    Attributes:
        peer: the remote party, once the connection is open.
        address: HOST:PORT of the remote party.
    """

    def __init__(
        self, sock: socket.socket, channel: Channel, wake: Callable[[], None], clock: Callable[[], float]
    ) -> None:
        self.address = channel.address
        self.since = self.last_received = self.last_sent = clock()
        self._clock = clock
        self.opened = False
        self._sock, self._channel, self._wake = sock, channel, wake
        self._lock = threading.Lock()
        self._in, self._out = bytearray(), bytearray()
        self._closing = ""

    @property
    def peer(self) -> Peer:
        """The remote party."""
        assert self._channel.peer is not None
        return self._channel.peer

    @property
    def negotiated(self) -> dict[str, str]:
        """Version, cipher and group of the encryption."""
        with self._lock:
            return self._channel.negotiated()

    def send(self, message: Mapping[str, Any]) -> bool:
        """Queue a message; thread-safe. False: the connection is closed, or closes as its reader is too slow."""
        return self._send(json.dumps(message, separators=(",", ":"), allow_nan=False).encode() + b"\n")

    def close(self, reason: str = "closed here") -> None:
        """Close the connection after sending what is queued."""
        self._closing = self._closing or reason
        self._wake()

    def _send(self, line: bytes) -> bool:
        with self._lock:
            if self._closing:
                return False
            try:
                self._channel.write(line)
            except TlsError as error:
                self._closing = str(error)
            else:
                self._out += self._channel.take()
                self.last_sent = self._clock()
                if len(self._out) > SEND_QUEUE_MAX_BYTES:
                    self._out.clear()
                    self._closing = "the remote end reads too slowly"
        self._wake()
        return not self._closing

    def _receive(self) -> list[bytes]:
        """Receive lines."""
        data = self._sock.recv(2**16)
        if not data:
            raise TlsClosed
        with self._lock:
            self._channel.put(data)
            try:
                if self._channel.established or self._channel.handshake():
                    while (part := self._channel.read()) is not None:
                        self._in += part
            except TlsClosed:  # closed once the lines before it are handled
                self._closing = self._closing or "closed by the remote end"
            finally:
                self._out += self._channel.take()
        *lines, rest = self._in.split(b"\n")
        if len(rest) > LINE_MAX_BYTES or any(len(line) > LINE_MAX_BYTES for line in lines):
            raise TlsError(f"received a line longer than {LINE_MAX_BYTES} bytes")
        self._in = rest
        if lines:
            self.last_received = self._clock()
        return [bytes(line) for line in lines]

    def _start_handshake(self) -> None:
        with self._lock:
            self._channel.handshake()
            self._out += self._channel.take()

    def _flush(self) -> None:
        with self._lock:
            while self._out and (sent := self._sock.send(self._out)):
                del self._out[:sent]

    def _end(self) -> None:
        with self._lock:
            self._closing = self._closing or "closed"
            self._channel.close()
            try:
                self._sock.send(self._out + self._channel.take())
            except OSError:
                pass
        self._sock.close()


class _Connections(threading.Thread):
    """All connections of a server or client, served by one thread."""

    def __init__(
        self,
        name: str,
        opened: Callable[[Connection], None],
        received: Callable[[Connection, JsonObject], None],
        closed: Callable[[Connection, str], None],
        clock: Callable[[], float],
    ) -> None:
        super().__init__(name=name, daemon=True)
        self._clock = clock
        self._callbacks = (opened, received, closed)
        self._selector = selectors.DefaultSelector()
        self._connections: dict[socket.socket, Connection] = {}
        self._stopping = threading.Event()
        self._wake_receiver, self._wake_sender = socket.socketpair()
        self._wake_receiver.setblocking(False)
        self._wake_sender.setblocking(False)
        self._selector.register(self._wake_receiver, selectors.EVENT_READ)

    def wake(self) -> None:
        """Make the thread check at once for work."""
        try:
            self._wake_sender.send(b"\0")
        except OSError:  # it is awake already, or has ended
            pass

    def close(self) -> None:
        """Close all connections, and end the thread."""
        self._stopping.set()
        self.wake()
        if threading.current_thread() is not self:
            self.join(HANDSHAKE_TIMEOUT_S)

    def run(self) -> None:
        """Serve until closed."""
        try:
            while not self._stopping.is_set():
                for key, events in self._selector.select(self._pause()):
                    sock = key.fileobj
                    assert isinstance(sock, socket.socket)
                    if sock is self._wake_receiver:
                        self._wake_receiver.recv(4096)
                    elif (connection := self._connections.get(sock)) is None:
                        self._accept()
                    elif events & selectors.EVENT_READ:
                        self._read(connection)
                self._maintain(self._clock())
        finally:
            for connection in list(self._connections.values()):
                self._drop(connection, "closed here")
            self._selector.close()
            self._wake_receiver.close()
            self._wake_sender.close()

    def _pause(self) -> float:
        return 0.5

    def _accept(self) -> None:
        """Accept a connection."""

    def _add(self, sock: socket.socket, channel: Channel) -> Connection:
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection = self._connections[sock] = Connection(sock, channel, self.wake, self._clock)
        self._selector.register(sock, selectors.EVENT_READ)
        return connection

    def _maintain(self, now: float) -> None:
        """Send heartbeats and queued data, and drop connections that are closed or timed out."""
        for connection in list(self._connections.values()):
            if connection.opened and now - connection.last_sent > HEARTBEAT_S:
                connection._send(b"\n")
            if connection._closing:
                self._drop(connection, connection._closing)
            elif now - connection.last_received > (IDLE_TIMEOUT_S if connection.opened else HANDSHAKE_TIMEOUT_S):
                self._drop(connection, "timed out")
            else:
                self._write(connection)

    def _write(self, connection: Connection) -> None:
        try:
            connection._flush()
        except BlockingIOError:
            pass
        except OSError as error:
            return self._drop(connection, str(error.strerror))
        events = selectors.EVENT_READ | (selectors.EVENT_WRITE if connection._out else 0)
        if self._selector.get_key(connection._sock).events != events:
            self._selector.modify(connection._sock, events)

    def _read(self, connection: Connection) -> None:
        try:
            lines = connection._receive()
            if not connection.opened and self._ready(connection, lines):
                connection.opened = True
                self._callbacks[0](connection)
            for line in filter(None, lines):
                self._callbacks[1](connection, _parse(line))
        except BlockingIOError:
            pass
        except TlsClosed:
            self._drop(connection, "closed by the remote end")
        except TlsError as error:
            self._drop(connection, str(error))
        except OSError as error:
            self._drop(connection, str(error.strerror))

    def _ready(self, connection: Connection, lines: list[bytes]) -> bool:
        """Whether the connection is open now."""
        return connection._channel.established

    def _drop(self, connection: Connection, reason: str) -> None:
        if self._connections.pop(connection._sock, None) is not None:
            self._selector.unregister(connection._sock)
            connection._end()
            self._callbacks[2](connection, reason)


class Server(_Connections):
    """The gateway's side.

    Args:
        port: TCP port; 0: any free one.
        accepts: whether to accept a party with a valid certificate; a party with the gateway role never is.
        opened, received, closed: callbacks; `closed` is also called for connections that were never `opened`.
        clock: current time, seconds.

    Raises:
        SettingError: it can't listen on this address.
        BusyError: the port is in use.
    """

    def __init__(
        self,
        identity: Identity,
        host: str,
        port: int,
        *,
        opened: Callable[[Connection], None],
        received: Callable[[Connection, JsonObject], None],
        closed: Callable[[Connection, str], None],
        accepts: Callable[[Peer], bool] = lambda peer: True,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__("teleop-server", opened, received, closed, clock)
        self._context = tls.context(identity, datagrams=False)
        self._accepts = accepts
        try:
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            self._listener = socket.create_server((host, port), family=family, backlog=HANDSHAKES_MAX)
        except OSError as error:
            if error.errno == 98:
                raise BusyError(
                    f"{host}:{port}", "is in use by another program", "End that program, or choose another port"
                ) from None
            raise SettingError(f"{host}:{port}", str(error.strerror), "Give an address of this machine") from None
        self._listener.setblocking(False)
        self.port: int = self._listener.getsockname()[1]
        self._selector.register(self._listener, selectors.EVENT_READ)
        self.start()

    def run(self) -> None:
        """Serve until closed."""
        try:
            super().run()
        finally:
            self._listener.close()

    def _accept(self) -> None:
        try:
            sock, (host, port, *_) = self._listener.accept()
        except OSError:
            return
        handshakes = Counter(connection.opened for connection in self._connections.values())[False]
        if handshakes >= HANDSHAKES_MAX or len(self._connections) >= CONNECTIONS_MAX:
            sock.close()
            return
        channel = Channel(self._context, client=False, accepts=self._accepts_peer, address=f"{host}:{port}")
        self._add(sock, channel)

    def _accepts_peer(self, peer: Peer) -> bool:
        return peer.role != Role.GATEWAY and self._accepts(peer)

    def _ready(self, connection: Connection, lines: list[bytes]) -> bool:
        return connection._channel.established and connection._send(b"\n")


class Client(_Connections):
    """The side of a vehicle or station: connects to the gateway, and reconnects.

    Args:
        closed: called with the reason, also after failed attempts; the client then retries by itself.
        clock: current time, seconds.
    """

    def __init__(
        self,
        identity: Identity,
        host: str,
        port: int,
        *,
        opened: Callable[[Connection], None],
        received: Callable[[Connection, JsonObject], None],
        closed: Callable[[str], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__("teleop-client", opened, received, lambda connection, reason: self._lost(reason), clock)
        self._context = tls.context(identity, datagrams=False)
        self._gateway, self._closed = (host, port), closed
        self._next, self._wait = float("-inf"), RECONNECT_DELAYS_S[0]
        self.start()

    def send(self, message: Mapping[str, Any]) -> bool:
        """Queue a message; False: the client isn't connected."""
        connection = next((one for one in list(self._connections.values()) if one.opened), None)
        return connection is not None and connection.send(message)

    @property
    def connected(self) -> bool:
        """Whether the client is connected."""
        return any(one.opened for one in list(self._connections.values()))

    def _pause(self) -> float:
        return 0.5 if self._connections else max(0.0, min(0.5, self._next - self._clock()))

    def _maintain(self, now: float) -> None:
        super()._maintain(now)
        if not self._connections and now >= self._next and not self._stopping.is_set():
            self._connect()

    def _connect(self) -> None:
        host, port = self._gateway
        self._next = self._clock() + self._wait
        try:
            sock = socket.create_connection((host, port), timeout=HANDSHAKE_TIMEOUT_S)
        except OSError as error:
            return self._lost(f"{host}:{port}: {error.strerror or error}")
        channel = Channel(self._context, client=True, accepts=self._is_gateway, address=f"{host}:{port}")
        connection = self._add(sock, channel)
        connection._start_handshake()
        self._write(connection)
        return None

    def _is_gateway(self, peer: Peer) -> bool:
        return peer.role == Role.GATEWAY and self._gateway[0] in peer.hosts

    def _ready(self, connection: Connection, lines: list[bytes]) -> bool:
        if lines:  # in TLS 1.3 the server checks our certificate after our side of the handshake is complete
            self._wait = RECONNECT_DELAYS_S[0]
        return bool(lines)

    def _lost(self, reason: str) -> None:
        self._next = self._clock() + self._wait
        self._wait = min(2 * self._wait, RECONNECT_DELAYS_S[1])
        self._closed(reason)


def _parse(line: bytes) -> JsonObject:
    try:
        message = json.loads(line, parse_constant=_refuse)
    except (ValueError, RecursionError):
        message = None
    if not isinstance(message, dict):
        raise TlsError("received a line that is not a JSON object")
    return message


def _refuse(constant: str) -> None:
    raise ValueError(constant)
