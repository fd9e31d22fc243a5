"""The vehicle's side of a multipath connection: connects to the station over every link, to each of its addresses.

Every DTLS session has its own socket. A link that is silent, or whose keys are due for renewal, gets a new session from
whatever local address it has by then, while the old one continues; the first handshake to complete replaces it.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.services.teleoperation.control.messages import Message
from scan2sim.services.teleoperation.identity import Identity, Peer
from scan2sim.services.teleoperation.transport import tls
from scan2sim.services.teleoperation.transport.clock_sync import ClockSync
from scan2sim.services.teleoperation.transport.dtls_session import DtlsSession
from scan2sim.services.teleoperation.transport.multipath import LINKS_MAX, LinkSession, MultipathConnection
from scan2sim.services.teleoperation.transport.tls import Channel
from scan2sim.services.teleoperation.transport.udp_reactor import (
    Address,
    OpenReactor,
    UdpReactor,
    UdpSocket,
    format_address,
    is_address,
)

REKEY_PERIOD_S = 600.0
"""Age of a session after which its keys are renewed."""
RECONNECT_PERIOD_S, ATTEMPTS_MAX, HANDSHAKE_TIMEOUT_S = 0.7, 4, 5.0
"""Interval between attempts to connect, their maximum number at once, and duration of one."""
REPLACED_SESSION_LIFETIME_S = 3.0
"""Time for which a replaced session is still read."""


@dataclass(frozen=True)
class Link:
    """A network link of the vehicle.

    Attributes:
        local: its IP address, or an interface name, whose address may change; empty: the system's default route.
    """

    name: str
    local: str = ""


@dataclass
class _Path:
    """A link to one of the station's addresses, with its sessions."""

    name: str
    link: Link
    remote: tuple[str, int]
    session: LinkSession | None = None
    attempts: dict[UdpSocket, LinkSession] = field(default_factory=dict)
    replaced: dict[UdpSocket, tuple[LinkSession, float]] = field(default_factory=dict)
    sock: UdpSocket | None = None
    last_attempt: float = float("-inf")


def connect_station(
    identity: Identity,
    peer: Peer,
    links: Sequence[Link],
    addresses: Sequence[tuple[str, int]],
    *,
    received: Callable[[Message], None],
    media: Callable[[bytes, str], None] = lambda packet, link: None,
    restarted: Callable[[], None] = lambda: None,
    renew: float = REKEY_PERIOD_S,
    clocks: ClockSync | None = None,
    clock: Callable[[], float] = time.monotonic,
    reactor: OpenReactor = UdpReactor,
) -> MultipathConnection:
    """Connect to a station until the connection is closed.

    Args:
        peer: the station, named by the gateway.
        addresses: of the station; IP addresses, to avoid name resolution.
        clock: current time, seconds.
        reactor: opens sockets, and reads them.

    Raises:
        SettingError: no links or addresses, too many of them, or a host that isn't an IP address.
    """
    if not 1 <= len(links) * len(addresses) <= LINKS_MAX:
        combinations = f"{len(links)} links to {len(addresses)} addresses"
        cause = f"{combinations} are no paths, or more than {LINKS_MAX}"
        raise SettingError("links", cause, "Give fewer links or addresses, but at least one of each")
    if wrong := next((host for host, _ in addresses if not is_address(host)), ""):
        raise SettingError("addresses", f"{wrong!r} is not an IP address", "Give the station's IP addresses")
    connection = MultipathConnection(
        received, media, restarted, clocks=clocks, on_close=lambda: connector.close(), clock=clock
    )
    connector = _Connector(identity, peer, links, addresses, connection, renew, clock, reactor)
    return connection


class _Connector:
    """Keeps all paths to a station connected."""

    def __init__(
        self,
        identity: Identity,
        peer: Peer,
        links: Sequence[Link],
        addresses: Sequence[tuple[str, int]],
        connection: MultipathConnection,
        renew: float,
        clock: Callable[[], float],
        reactor: OpenReactor,
    ) -> None:
        self._context = tls.context(identity, datagrams=True)
        self._peer, self._renew, self._clock = peer, renew, clock
        multiple_addresses = len(addresses) > 1
        self._paths = [
            _Path(f"{link.name}>{format_address(remote)}" if multiple_addresses else link.name, link, remote)
            for link in links
            for remote in addresses
        ]
        self._path_of: dict[UdpSocket, _Path] = {}
        self.connection = connection
        for path in self._paths:
            self.connection.report_down(path.name, "connecting")
        self._reactor = reactor(self._receive, self._tick, clock)
        self._reactor.start()

    def _receive(self, sock: UdpSocket, data: bytes, address: Address) -> None:
        path = self._path_of[sock]
        attempt = path.attempts.get(sock)
        session = attempt or (path.session if sock is path.sock else path.replaced[sock][0])
        assert session is not None
        if data and 128 <= data[0] < 192:
            if attempt is None:
                self.connection.receive_media(session, data)
            return
        for part in session.dtls.receive(data, self._clock()):
            self.connection.receive_message(session, part)
        if attempt is not None and session.dtls.established is not None:
            self._use_session(path, sock, session)
        elif attempt is not None and session.dtls.ended:
            self._abandon(path, sock, session.dtls.ended)

    def _use_session(self, path: _Path, sock: UdpSocket, session: LinkSession) -> None:
        """Use a session whose handshake is complete."""
        now = self._clock()
        del path.attempts[sock]
        if path.sock is not None and path.session is not None:
            path.replaced[path.sock] = (path.session, now + REPLACED_SESSION_LIFETIME_S)
        path.sock, path.session = sock, session
        self.connection.attach(session)
        self.connection.tick(now)  # sends a ping: the station attaches the link on its first message
        for other in list(path.attempts):
            self._close_session(path, other, path.attempts.pop(other))

    def _abandon(self, path: _Path, sock: UdpSocket, reason: str) -> None:
        self._close_session(path, sock, path.attempts.pop(sock))
        if path.session is None:
            self.connection.report_down(path.name, reason)

    def _close_session(self, path: _Path, sock: UdpSocket, session: LinkSession) -> None:
        session.dtls.close()
        del self._path_of[sock]
        self._reactor.remove(sock)

    def _tick(self, now: float) -> None:
        for path in self._paths:
            for sock, session in list(path.attempts.items()):
                session.dtls.tick(now)
                if session.dtls.ended or now - session.dtls.started > HANDSHAKE_TIMEOUT_S:
                    self._abandon(path, sock, session.dtls.ended or "no answer")
            for sock, (session, until) in list(path.replaced.items()):
                if now > until:
                    del path.replaced[sock]
                    self._close_session(path, sock, session)
            if (current := path.session) is not None and current.dtls.ended and path.sock is not None:
                self.connection.detach(current)
                self._close_session(path, path.sock, current)
                path.session = path.sock = None
            if self._is_due(path, now):
                self._start_attempt(path, now)
        self.connection.tick(now)

    def _is_due(self, path: _Path, now: float) -> bool:
        """Whether to attempt a new session."""
        if len(path.attempts) >= ATTEMPTS_MAX or now - path.last_attempt < RECONNECT_PERIOD_S:
            return False
        one = path.session
        return one is None or not one.up(now) or now - one.dtls.started > self._renew

    def _start_attempt(self, path: _Path, now: float) -> None:
        path.last_attempt = now
        try:
            sock = self._reactor.connect(path.link.local, path.remote)
        except OSError as error:
            if path.session is None:
                reason = f"{path.link.local}: {os.strerror(error.errno or 0)}".removeprefix(": ")
                self.connection.report_down(path.name, reason)
            return
        send = _sender(sock, self.connection)
        channel = Channel(self._context, client=True, accepts=self._peer.__eq__, address=format_address(path.remote))
        dtls = DtlsSession(channel, send, self.connection.counter, now)
        session = LinkSession(path.name, dtls, send, format_address(sock.getsockname()), format_address(path.remote))
        self._path_of[sock], path.attempts[sock] = path, session
        dtls.start_handshake(now)

    def close(self) -> None:
        """Close all sessions and sockets."""

        def close_all() -> None:
            for path in self._paths:
                for session in (path.session, *path.attempts.values(), *(one for one, _ in path.replaced.values())):
                    if session is not None:
                        session.dtls.close()
                        self.connection.detach(session)

        self._reactor.call_soon(close_all)
        self._reactor.end()


def _sender(sock: UdpSocket, connection: MultipathConnection) -> Callable[[bytes], None]:
    def send(data: bytes) -> None:
        try:
            sock.send(data)
        except OSError:  # the send queue is full, or there is no route at present: the datagram is lost
            connection.counter["unsent"] += 1

    return send
