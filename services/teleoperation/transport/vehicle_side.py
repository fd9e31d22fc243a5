"""The vehicle's end of a bundle: it dials the station, over every link to each of its addresses.

Every association has a socket of its own. A link that is silent, or whose keys are to be renewed, is dialled again
beside the old association, from whatever address it has by then; whichever attempt gets through first takes over.
"""

from __future__ import annotations

import ipaddress
import os
import socket
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.services.teleoperation.control.messages import Message
from scan2sim.services.teleoperation.gateway.identity import Identity, Peer
from scan2sim.services.teleoperation.transport import tls
from scan2sim.services.teleoperation.transport.clock_sync import Clocks
from scan2sim.services.teleoperation.transport.dtls_session import Association
from scan2sim.services.teleoperation.transport.multipath import NAMES, Bundle, Carrier
from scan2sim.services.teleoperation.transport.tls import Channel
from scan2sim.services.teleoperation.transport.udp_reactor import Reader, shown, udp

RENEW = 600.0
"""Seconds until keys are renewed."""
APART, ATTEMPTS, PATIENCE = 0.7, 4, 5.0
"""Seconds between attempts to dial; how many at once; seconds that one lasts."""
KEEP = 3.0
"""Seconds that an association is read after another took its place."""


@dataclass(frozen=True)
class Link:
    """A way out of the vehicle.

    Attributes:
        local: its address, or the interface's name, which may change its address; empty: as the system routes.
    """

    name: str
    local: str = ""

    def socket(self, remote: tuple[str, int]) -> socket.socket:
        """A new socket from here to there.

        Raises:
            OSError: there is no such way now.
        """
        sock = udp(socket.AF_INET6 if ":" in remote[0] else socket.AF_INET)
        try:
            if self.local and _is_address(self.local):
                sock.bind((self.local, 0))
            elif self.local:
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, self.local.encode())
            sock.connect(remote)
        except OSError:
            sock.close()
            raise
        return sock


@dataclass
class _Way:
    """A link to one of the station's addresses."""

    name: str
    link: Link
    remote: tuple[str, int]
    carrier: Carrier | None = None
    attempts: dict[socket.socket, Carrier] = field(default_factory=dict)
    old: dict[socket.socket, tuple[Carrier, float]] = field(default_factory=dict)
    sock: socket.socket | None = None
    tried: float = float("-inf")


def dial(
    identity: Identity,
    peer: Peer,
    links: Sequence[Link],
    addresses: Sequence[tuple[str, int]],
    *,
    received: Callable[[Message], None],
    media: Callable[[bytes, str], None] = lambda packet, link: None,
    began: Callable[[], None] = lambda: None,
    renew: float = RENEW,
    clocks: Clocks | None = None,
) -> Bundle:
    """Dial a station until the bundle is closed.

    Args:
        peer: the station, as the gateway tells it.
        addresses: of the station; hosts as numbers, so that nothing waits for a name.

    Raises:
        SettingError: no links or addresses, too many, or a host that is none.
    """
    if not 1 <= len(links) * len(addresses) <= NAMES:
        ways = f"{len(links)} links to {len(addresses)} addresses"
        raise SettingError("links", f"{ways} are none, or more than {NAMES} ways", "Name fewer links, or addresses")
    if wrong := next((host for host, _ in addresses if not _is_address(host)), ""):
        raise SettingError("addresses", f"{wrong!r} is no IP address", "Give the station's addresses as numbers")
    return _Dialler(identity, peer, links, addresses, received, media, began, renew, clocks).bundle


class _Dialler:
    """Keeps all ways to a station dialled."""

    def __init__(
        self,
        identity: Identity,
        peer: Peer,
        links: Sequence[Link],
        addresses: Sequence[tuple[str, int]],
        received: Callable[[Message], None],
        media: Callable[[bytes, str], None],
        began: Callable[[], None],
        renew: float,
        clocks: Clocks | None,
    ) -> None:
        self._context = tls.context(identity, datagrams=True)
        self._peer, self._renew = peer, renew
        several = len(addresses) > 1
        self._ways = [
            _Way(f"{link.name}>{shown(remote)}" if several else link.name, link, remote)
            for link in links
            for remote in addresses
        ]
        self._of: dict[socket.socket, _Way] = {}
        self.bundle = Bundle(received, media, began, clocks=clocks, closing=self._close)
        for way in self._ways:
            self.bundle.known(way.name, "is being dialled")
        self._reader = Reader(self._came, self._tick)
        self._reader.start()

    def _came(self, sock: socket.socket, data: bytes, address: tuple[object, ...]) -> None:
        way = self._of[sock]
        attempt = way.attempts.get(sock)
        carrier = attempt or (way.carrier if sock is way.sock else way.old[sock][0])
        assert carrier is not None
        if data and 128 <= data[0] < 192:
            if attempt is None:
                self.bundle.packet(carrier, data)
            return
        for part in carrier.association.receive(data, time.monotonic()):
            self.bundle.arrived(carrier, part)
        if attempt is not None and carrier.association.established is not None:
            self._through(way, sock, carrier)
        elif attempt is not None and carrier.association.ended:
            self._failed(way, sock, carrier.association.ended)

    def _through(self, way: _Way, sock: socket.socket, carrier: Carrier) -> None:
        """An attempt has become an association: it takes over."""
        now = time.monotonic()
        del way.attempts[sock]
        if way.sock is not None and way.carrier is not None:
            way.old[way.sock] = (way.carrier, now + KEEP)
        way.sock, way.carrier = sock, carrier
        self.bundle.attach(carrier)
        self.bundle.tick(now)  # a ping: the station takes the link up by its first message
        for other in list(way.attempts):
            self._shut(way, other, way.attempts.pop(other))

    def _failed(self, way: _Way, sock: socket.socket, why: str) -> None:
        self._shut(way, sock, way.attempts.pop(sock))
        if way.carrier is None:
            self.bundle.known(way.name, why)

    def _shut(self, way: _Way, sock: socket.socket, carrier: Carrier) -> None:
        carrier.association.close()
        del self._of[sock]
        self._reader.remove(sock)

    def _tick(self, now: float) -> None:
        for way in self._ways:
            for sock, carrier in list(way.attempts.items()):
                carrier.association.tick(now)
                if carrier.association.ended or now - carrier.association.began > PATIENCE:
                    self._failed(way, sock, carrier.association.ended or "no answer")
            for sock, (carrier, until) in list(way.old.items()):
                if now > until:
                    del way.old[sock]
                    self._shut(way, sock, carrier)
            if (current := way.carrier) is not None and current.association.ended and way.sock is not None:
                self.bundle.detach(current)
                self._shut(way, way.sock, current)
                way.carrier = way.sock = None
            if self._wanted(way, now):
                self._attempt(way, now)
        self.bundle.tick(now)

    def _wanted(self, way: _Way, now: float) -> bool:
        """Whether a new association is to be tried for."""
        if len(way.attempts) >= ATTEMPTS or now - way.tried < APART:
            return False
        one = way.carrier
        return one is None or not one.up(now) or now - one.association.began > self._renew

    def _attempt(self, way: _Way, now: float) -> None:
        way.tried = now
        try:
            sock = way.link.socket(way.remote)
        except OSError as error:
            if way.carrier is None:
                self.bundle.known(way.name, f"{way.link.local}: {os.strerror(error.errno or 0)}".removeprefix(": "))
            return
        put = _putter(sock, self.bundle)
        channel = Channel(self._context, client=True, accepts=self._peer.__eq__, address=shown(way.remote))
        association = Association(channel, put, self.bundle.counter, now)
        carrier = Carrier(way.name, association, put, shown(sock.getsockname()), shown(way.remote))
        self._of[sock], way.attempts[sock] = way, carrier
        self._reader.add(sock)
        association.dial(now)

    def _close(self) -> None:
        def all_() -> None:
            for way in self._ways:
                for carrier in (way.carrier, *way.attempts.values(), *(one for one, _ in way.old.values())):
                    if carrier is not None:
                        carrier.association.close()
                        self.bundle.detach(carrier)

        self._reader.soon(all_)
        self._reader.end()


def _putter(sock: socket.socket, bundle: Bundle) -> Callable[[bytes], None]:
    def put(data: bytes) -> None:
        try:
            sock.send(data)
        except OSError:  # the queue is full, or there is no way at present: lost, as on any network
            bundle.counter["unsent"] += 1

    return put


def _is_address(text: str) -> bool:
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return False
    return True
