"""The station's side of multipath connections: listens, and accepts the links of the vehicles that it expects.

A client must first prove that it receives at its address (DTLS cookie); until then no state is kept for it. A vehicle
that isn't expected, by role, name and certificate, is rejected in the handshake. The number of handshakes is limited,
for each host and in total, so that a flood of them costs only bounded time.
"""

from __future__ import annotations

import errno
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from scan2sim.pipeline.core.errors import BusyError, SettingError
from scan2sim.services.teleoperation.control.messages import Kind, Malformed, Message
from scan2sim.services.teleoperation.identity import Identity, Peer
from scan2sim.services.teleoperation.transport import tls
from scan2sim.services.teleoperation.transport.clock_sync import ClockSync
from scan2sim.services.teleoperation.transport.dtls_session import DtlsSession, is_hello
from scan2sim.services.teleoperation.transport.multipath import SESSION_BYTES, LinkSession, MultipathConnection
from scan2sim.services.teleoperation.transport.tls import Channel, TlsError
from scan2sim.services.teleoperation.transport.udp_reactor import (
    Address,
    OpenReactor,
    Reactor,
    UdpReactor,
    UdpSocket,
    format_address,
)

HANDSHAKES_MAX, HANDSHAKES_PER_HOST_MAX, HANDSHAKE_TIMEOUT_S = 64, 16, 5.0
"""Maximum number of concurrent handshakes, of those from one host, and duration of one."""
HELLO_RATE_MAX, HELLO_RATE_PER_HOST_MAX = 500.0, 50.0
"""Maximum number of ClientHello datagrams answered per second, and of those from one host."""
TRACKED_HOSTS_MAX = 1024
"""Number of hosts whose rates are tracked."""
SESSIONS_PER_PEER_MAX = 32
"""Maximum number of DTLS sessions of one peer."""
REPLACED_SESSION_LIFETIME_S, SESSION_TIMEOUT_S = 3.0, 30.0
"""Time for which a replaced session is still read; silence after which a session is dropped."""


class TokenBucket:
    """Token bucket rate limit; bursts of up to one second's tokens."""

    def __init__(self, rate: float) -> None:
        self._rate = self._tokens = rate
        self._updated = 0.0

    def take(self, now: float) -> bool:
        """Take a token; returns whether there was one."""
        self._tokens = min(self._rate, self._tokens + (now - self._updated) * self._rate)
        self._updated = now
        if self._tokens < 1:
            return False
        self._tokens -= 1
        return True


@dataclass
class _RemoteSession:
    """DTLS session with a remote address: a handshake, then a link session of a connection, named by its first ping."""

    sock: UdpSocket
    address: Address
    dtls: DtlsSession
    connection: MultipathConnection | None = None
    link_session: LinkSession | None = None
    until: float = float("inf")

    @property
    def attached(self) -> bool:
        """Whether the name of its link is known, so that messages are sent over it."""
        return self.link_session is not None and self.link_session.name != ""


class Listener:
    """Accepts connections of peers on sockets that stay open.

    Args:
        addresses: (host, port) to listen on; port 0: any free one. List the addresses of a multihomed machine.
        clock: current time, seconds.
        reactor: opens sockets, and reads them.

    Attributes:
        addresses: where it listens.

    Raises:
        SettingError: it can't listen on an address.
        BusyError: a port is in use.
    """

    def __init__(
        self,
        identity: Identity,
        addresses: Sequence[tuple[str, int]],
        *,
        clock: Callable[[], float] = time.monotonic,
        reactor: OpenReactor = UdpReactor,
    ) -> None:
        self._clock = clock
        self._context = tls.context(identity, datagrams=True)
        self._expected: dict[Peer, MultipathConnection] = {}
        self._sessions: dict[tuple[int, Address], _RemoteSession] = {}
        self._pending: dict[tuple[int, Address], _RemoteSession] = {}
        self._counts: Counter[str] = Counter()
        self._hellos = TokenBucket(HELLO_RATE_MAX)
        self._hosts: OrderedDict[object, TokenBucket] = OrderedDict()
        self._next_channel = self._new_channel()
        self._reactor = reactor(self._receive, self._tick, clock)
        sockets = [_bind(self._reactor, *address) for address in addresses]
        self.addresses: tuple[tuple[str, int], ...] = tuple(_host_and_port(sock) for sock in sockets)
        self._reactor.start()

    @property
    def port(self) -> int:
        """Port of the first address."""
        return self.addresses[0][1]

    @property
    def counts(self) -> Mapping[str, int]:
        """Number of dropped datagrams without a connection, by reason: unknown_senders, malformed, flooded, ..."""
        return dict(self._counts)

    def expect(
        self,
        peer: Peer,
        received: Callable[[Message], None],
        media: Callable[[bytes, str], None] = lambda packet, link: None,
        restarted: Callable[[], None] = lambda: None,
        *,
        clocks: ClockSync | None = None,
    ) -> MultipathConnection:
        """Accept a peer, named by the gateway; its links are added to the connection as they come up."""
        self.forget(peer)
        connection = MultipathConnection(
            received, media, restarted,
            clocks=clocks, on_close=lambda: self._forget(peer, connection), clock=self._clock,
        )  # fmt: skip
        self._expected[peer] = connection
        return connection

    def forget(self, peer: Peer) -> None:
        """Stop accepting a peer, and close its links."""
        if (connection := self._expected.get(peer)) is not None:
            connection.close()

    def close(self) -> None:
        """Close all connections and sockets."""
        for peer in list(self._expected):
            self.forget(peer)
        self._reactor.end()

    def _forget(self, peer: Peer, connection: MultipathConnection) -> None:
        if self._expected.get(peer) is connection:
            del self._expected[peer]
        self._reactor.call_soon(lambda: self._drop_all(connection))

    def _drop_all(self, connection: MultipathConnection) -> None:
        for key, entry in list(self._sessions.items()):
            if entry.connection is connection:
                self._drop(key, entry)

    def _new_channel(self) -> Channel:
        return Channel(self._context, client=False, accepts=lambda peer: peer in self._expected)

    def _receive(self, sock: UdpSocket, data: bytes, address: Address) -> None:
        key = (sock.fileno(), address)
        entry = self._sessions.get(key)
        if entry is None:
            self._receive_hello(key, sock, data, address)
        elif data and 128 <= data[0] < 192:
            if entry.connection is not None and entry.link_session is not None and entry.attached:
                entry.connection.receive_media(entry.link_session, data)
        else:
            for part in entry.dtls.receive(data, self._clock()):
                self._receive_message(entry, part)
            if key in self._pending:
                self._check_handshake(key, entry)

    def _check_handshake(self, key: tuple[int, Address], entry: _RemoteSession) -> None:
        """Check whether a handshake has completed or failed."""
        one = entry.dtls
        if one.ended:
            self._counts["rejected"] += 1
            self._drop(key, entry)
        elif one.established is not None and one.peer is not None:
            del self._pending[key]
            entry.connection = self._expected.get(one.peer)
            mine = [each for each in self._sessions.items() if each[1].connection is entry.connection]
            if entry.connection is None:
                return self._drop(key, entry)
            send, local = self._sender(entry.sock, entry.address), format_address(entry.sock.getsockname())
            entry.link_session = LinkSession("", one, send, local, format_address(entry.address))
            if len(mine) > SESSIONS_PER_PEER_MAX:
                self._drop(*min(mine, key=lambda each: each[1].dtls.last_received))

    def _receive_message(self, entry: _RemoteSession, part: bytes) -> None:
        """Process a message of a peer; the first ping, which names the link, may arrive after others, or get lost."""
        if entry.connection is None or entry.link_session is None:
            return
        if not entry.attached and (name := _link_name(part)) is not None:
            if not 0 < len(name) <= 60 or entry.connection.is_full(name):
                self._counts["unnamed"] += 1
                return
            self._attach_link(entry.connection, entry.link_session, name)
        entry.connection.receive_message(entry.link_session, part)

    def _attach_link(self, connection: MultipathConnection, link_session: LinkSession, name: str) -> None:
        link_session.name, link_session.dtls.counts = name, connection.counter
        before = connection.attach(link_session)
        for other in self._sessions.values():
            if other.link_session is before and before is not None:
                other.until = self._clock() + REPLACED_SESSION_LIFETIME_S

    def _receive_hello(self, key: tuple[int, Address], sock: UdpSocket, data: bytes, address: Address) -> None:
        if not is_hello(data):
            self._counts["unknown_senders"] += 1
            return
        now = self._clock()
        if not self._is_within_rate(address[0], now):
            self._counts["flooded"] += 1
            return
        send, channel = self._sender(sock, address), self._next_channel
        channel.address = format_address(address)
        try:
            proven = channel.listen(data)
        except TlsError:
            proven = False
        if not proven:
            if answer := channel.take():
                send(answer)
            else:  # not a valid ClientHello; the channel may have kept part of it
                self._counts["malformed"] += 1
                self._next_channel = self._new_channel()
            return
        self._next_channel = self._new_channel()
        from_host = sum(1 for each in self._pending.values() if each.address[0] == address[0])
        if len(self._pending) >= HANDSHAKES_MAX or from_host >= HANDSHAKES_PER_HOST_MAX:
            self._counts["flooded"] += 1
            return
        dtls = DtlsSession(channel, send, self._counts, now)
        self._sessions[key] = self._pending[key] = _RemoteSession(sock, address, dtls)
        dtls.start_handshake(now)
        self._check_handshake(key, self._sessions[key])

    def _is_within_rate(self, host: object, now: float) -> bool:
        bucket = self._hosts.setdefault(host, TokenBucket(HELLO_RATE_PER_HOST_MAX))
        self._hosts.move_to_end(host)
        if len(self._hosts) > TRACKED_HOSTS_MAX:
            self._hosts.popitem(last=False)
        return bucket.take(now) and self._hellos.take(now)

    def _tick(self, now: float) -> None:
        for key, entry in list(self._sessions.items()):
            one = entry.dtls
            if key in self._pending:
                one.tick(now)
            timed_out = (
                now - one.started > HANDSHAKE_TIMEOUT_S
                if not entry.attached
                else now - one.last_received > SESSION_TIMEOUT_S
            )
            if one.ended or timed_out or now > entry.until:
                self._counts["rejected"] += key in self._pending
                self._drop(key, entry)
        for connection in list(self._expected.values()):
            connection.tick(now)

    def _drop(self, key: tuple[int, Address], entry: _RemoteSession) -> None:
        self._sessions.pop(key, None)
        self._pending.pop(key, None)
        entry.dtls.close()
        if entry.connection is not None and entry.link_session is not None:
            entry.connection.detach(entry.link_session)

    def _sender(self, sock: UdpSocket, address: Address) -> Callable[[bytes], None]:
        def send(data: bytes) -> None:
            try:
                sock.sendto(data, address)
            except OSError:  # the send queue is full, or there is no route at present: the datagram is lost
                self._counts["unsent"] += 1

        return send


def _bind(reactor: Reactor, host: str, port: int) -> UdpSocket:
    try:
        return reactor.bind(host, port)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            remedy = "End that program, or choose another port"
            raise BusyError(f"{host}:{port}", "is in use by another program", remedy) from None
        raise SettingError(f"{host}:{port}", str(error.strerror), "Give an address of this machine") from None


def _host_and_port(sock: UdpSocket) -> tuple[str, int]:
    host, port, *_ = sock.getsockname()
    assert isinstance(host, str) and isinstance(port, int)
    return host, port


def _link_name(part: bytes) -> str | None:
    """Name of the link in a ping, empty if malformed; None: the message is of another kind, or malformed."""
    try:
        message = Message.unpack(part[SESSION_BYTES:])
        return message.body.decode() if message.kind == Kind.PING else None
    except UnicodeDecodeError:
        return ""
    except Malformed:
        return None
