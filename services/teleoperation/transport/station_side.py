"""The station's end of bundles: it listens, and takes up the links of the vehicles that it expects.

Whoever begins a handshake must first show that it gets what is sent to its address (DTLS's cookie); until then nothing
is kept of it. A vehicle that isn't expected, by role, name and certificate, is refused in the handshake. Handshakes
have bounds by host and altogether, so that a flood of them takes no more time than these allow.
"""

from __future__ import annotations

import socket
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from scan2sim.pipeline.core.errors import BusyError, SettingError
from scan2sim.services.teleoperation.control.messages import Kind, Malformed, Message
from scan2sim.services.teleoperation.gateway.identity import Identity, Peer
from scan2sim.services.teleoperation.transport import tls
from scan2sim.services.teleoperation.transport.clock_sync import Clocks
from scan2sim.services.teleoperation.transport.dtls_session import Association, is_hello
from scan2sim.services.teleoperation.transport.multipath import SESSION, Bundle, Carrier
from scan2sim.services.teleoperation.transport.tls import Channel, Refused
from scan2sim.services.teleoperation.transport.udp_reactor import Reader, shown, udp

PENDING, OF_HOST, PATIENCE = 64, 16, 5.0
"""Handshakes at once, of these by one host; seconds that one may take."""
HELLOS, HOST_HELLOS = 500.0, 50.0
"""First datagrams a second that are answered, of these from one host."""
HOSTS = 1024
"""Hosts whose rates are remembered."""
CARRIERS = 32
"""Associations of a peer at once."""
KEEP, FORGET = 3.0, 30.0
"""Seconds that an association is read after another took its place; seconds of silence until one is forgotten."""

Address = tuple[object, ...]


class Bucket:
    """A rate, and as much at once as a second brings."""

    def __init__(self, rate: float) -> None:
        self._rate = self._left = rate
        self._at = 0.0

    def take(self, now: float) -> bool:
        """Whether one more is within the rate."""
        self._left = min(self._rate, self._left + (now - self._at) * self._rate)
        self._at = now
        if self._left < 1:
            return False
        self._left -= 1
        return True


@dataclass
class _Entry:
    """What is at an address: a handshake, then a carrier of a bundle's."""

    sock: socket.socket
    address: Address
    association: Association
    bundle: Bundle | None = None
    carrier: Carrier | None = None
    until: float = float("inf")


class Listener:
    """Sockets that stay, while peers come and go.

    Args:
        addresses: (host, port) to listen at; port 0: any. Name a machine's addresses one by one where it has several.

    Attributes:
        addresses: where it listens.

    Raises:
        SettingError: it can't listen there.
        BusyError: something else does.
    """

    def __init__(self, identity: Identity, addresses: Sequence[tuple[str, int]]) -> None:
        self._context = tls.context(identity, datagrams=True)
        self._expected: dict[Peer, Bundle] = {}
        self._at: dict[tuple[int, Address], _Entry] = {}
        self._pending: dict[tuple[int, Address], _Entry] = {}
        self._counts: Counter[str] = Counter()
        self._hellos = Bucket(HELLOS)
        self._hosts: OrderedDict[object, Bucket] = OrderedDict()
        self._waiting = self._fresh()
        self._reader = Reader(self._came, self._tick)
        sockets = [_bound(*address) for address in addresses]
        for sock in sockets:
            self._reader.add(sock)
        self.addresses: tuple[tuple[str, int], ...] = tuple(sock.getsockname()[:2] for sock in sockets)
        self._reader.start()

    @property
    def port(self) -> int:
        """Where it listens, of its first address."""
        return self.addresses[0][1]

    @property
    def counts(self) -> Mapping[str, int]:
        """Of strangers' datagrams, why they weren't taken: strangers, malformed, flooded, refused, ..."""
        return dict(self._counts)

    def expect(
        self,
        peer: Peer,
        received: Callable[[Message], None],
        media: Callable[[bytes, str], None] = lambda packet, link: None,
        began: Callable[[], None] = lambda: None,
        *,
        clocks: Clocks | None = None,
    ) -> Bundle:
        """Let a peer in, as the gateway names it; the bundle has its links as they come."""
        self.forget(peer)
        bundle = Bundle(received, media, began, clocks=clocks, closing=lambda: self._forget(peer, bundle))
        self._expected[peer] = bundle
        return bundle

    def forget(self, peer: Peer) -> None:
        """Let a peer in no more, and end its links."""
        if (bundle := self._expected.get(peer)) is not None:
            bundle.close()

    def close(self) -> None:
        """End all."""
        for peer in list(self._expected):
            self.forget(peer)
        self._reader.end()

    def _forget(self, peer: Peer, bundle: Bundle) -> None:
        if self._expected.get(peer) is bundle:
            del self._expected[peer]
        self._reader.soon(lambda: self._drop_all(bundle))

    def _drop_all(self, bundle: Bundle) -> None:
        for key, entry in list(self._at.items()):
            if entry.bundle is bundle:
                self._drop(key, entry)

    def _fresh(self) -> Channel:
        return Channel(self._context, client=False, accepts=lambda peer: peer in self._expected)

    def _came(self, sock: socket.socket, data: bytes, address: Address) -> None:
        key = (sock.fileno(), address)
        entry = self._at.get(key)
        if entry is None:
            self._stranger(key, sock, data, address)
        elif data and 128 <= data[0] < 192:
            if entry.bundle is not None and entry.carrier is not None:
                entry.bundle.packet(entry.carrier, data)
        else:
            for part in entry.association.receive(data, time.monotonic()):
                self._said(key, entry, part)
            if key in self._pending:
                self._shaken(key, entry)

    def _shaken(self, key: tuple[int, Address], entry: _Entry) -> None:
        """A handshake has gone on: perhaps it is done."""
        one = entry.association
        if one.ended:
            self._counts["refused"] += 1
            self._drop(key, entry)
        elif one.established is not None and one.peer is not None:
            del self._pending[key]
            entry.bundle = self._expected.get(one.peer)
            mine = [each for each in self._at.items() if each[1].bundle is entry.bundle]
            if entry.bundle is None:
                self._drop(key, entry)
            elif len(mine) > CARRIERS:
                self._drop(*min(mine, key=lambda each: each[1].association.heard))

    def _said(self, key: tuple[int, Address], entry: _Entry, part: bytes) -> None:
        """A message of a peer's; its first ping by an association names the link."""
        if entry.bundle is None:
            return
        if entry.carrier is None:
            try:
                ping = Message.unpack(part[SESSION:])
                name = ping.body.decode() if ping.kind == Kind.PING else ""
            except (Malformed, UnicodeDecodeError):
                name = ""
            if not name or len(name) > 60 or entry.bundle.full(name):
                self._counts["unnamed"] += 1
                return
            self._take_up(entry, name)
        assert entry.carrier is not None
        entry.bundle.arrived(entry.carrier, part)

    def _take_up(self, entry: _Entry, name: str) -> None:
        put = self._putter(entry.sock, entry.address)
        assert entry.bundle is not None
        here = shown(entry.sock.getsockname())
        entry.carrier = Carrier(name, entry.association, put, here, shown(entry.address))
        entry.association.counts = entry.bundle.counter
        before = entry.bundle.attach(entry.carrier)
        for other in self._at.values():
            if other.carrier is before and before is not None:
                other.until = time.monotonic() + KEEP

    def _stranger(self, key: tuple[int, Address], sock: socket.socket, data: bytes, address: Address) -> None:
        if not is_hello(data):
            self._counts["strangers"] += 1
            return
        now = time.monotonic()
        if not self._within(address[0], now):
            self._counts["flooded"] += 1
            return
        put, channel = self._putter(sock, address), self._waiting
        channel.address = shown(address)
        try:
            shows = channel.listen(data)
        except Refused:
            shows = False
        if not shows:
            if answer := channel.take():
                put(answer)
            else:  # no hello after all, which it may have half kept
                self._counts["malformed"] += 1
                self._waiting = self._fresh()
            return
        self._waiting = self._fresh()
        of_host = sum(1 for each in self._pending.values() if each.address[0] == address[0])
        if len(self._pending) >= PENDING or of_host >= OF_HOST:
            self._counts["flooded"] += 1
            return
        association = Association(channel, put, self._counts, now)
        self._at[key] = self._pending[key] = _Entry(sock, address, association)
        association.dial(now)
        self._shaken(key, self._at[key])

    def _within(self, host: object, now: float) -> bool:
        bucket = self._hosts.setdefault(host, Bucket(HOST_HELLOS))
        self._hosts.move_to_end(host)
        if len(self._hosts) > HOSTS:
            self._hosts.popitem(last=False)
        return bucket.take(now) and self._hellos.take(now)

    def _tick(self, now: float) -> None:
        for key, entry in list(self._at.items()):
            one = entry.association
            if key in self._pending:
                one.tick(now)
            late = now - one.began > PATIENCE if entry.carrier is None else now - one.heard > FORGET
            if one.ended or late or now > entry.until:
                self._counts["refused"] += key in self._pending
                self._drop(key, entry)
        for bundle in list(self._expected.values()):
            bundle.tick(now)

    def _drop(self, key: tuple[int, Address], entry: _Entry) -> None:
        self._at.pop(key, None)
        self._pending.pop(key, None)
        entry.association.close()
        if entry.bundle is not None and entry.carrier is not None:
            entry.bundle.detach(entry.carrier)

    def _putter(self, sock: socket.socket, address: Address) -> Callable[[bytes], None]:
        def put(data: bytes) -> None:
            try:
                sock.sendto(data, address)
            except OSError:  # the queue is full, or there is no way at present: lost, as on any network
                self._counts["unsent"] += 1

        return put


def _bound(host: str, port: int) -> socket.socket:
    sock = udp(socket.AF_INET6 if ":" in host else socket.AF_INET)
    try:
        sock.bind((host, port))
    except OSError as error:
        sock.close()
        if error.errno == 98:
            raise BusyError(f"{host}:{port}", "another program listens there", "End it, or choose another") from None
        raise SettingError(f"{host}:{port}", str(error.strerror), "Name an address of this machine") from None
    return sock
