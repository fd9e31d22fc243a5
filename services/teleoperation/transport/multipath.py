"""All links to a peer as one: every message goes over all of them, and the first of each is taken.

A bundle knows no socket: `dialling` (the vehicle) and `listening` (the station) bring it carriers, one an association,
and hand it what comes by them. In a datagram stands the sender's session, then the message: a peer that starts anew
counts its messages from 0 again, and its session tells so.
"""

from __future__ import annotations

import logging
import secrets
import struct
import threading
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum

from scan2sim.services.teleoperation.control.messages import HEADER, LARGEST, Kind, Malformed, Message
from scan2sim.services.teleoperation.transport.clock_sync import Clocks
from scan2sim.services.teleoperation.transport.dedup_window import Window
from scan2sim.services.teleoperation.transport.dtls_session import Association

log = logging.getLogger(__name__)

SILENT, UNANSWERED = 1.0, 2.0
"""Seconds without anything from the peer, and without an answer to a ping, until a link counts as down."""
PING, QUICK, QUICKLY = 0.2, 0.05, 8
"""Seconds between pings of a link; of its first ones, and how many these are."""
NAMES = 16
"""Links of a peer, at most."""
SESSION = 4
"""Bytes before each message that tell the sender's session."""
_PONG = struct.Struct("<qqqf")  # ping's and its arrival's time, wall clock, loss
_SHRINK, _GROW, _LEAST = 0.7, 1.05, 0.05
_BAD_LOSS, _BAD_DELAY = 0.02, 0.1


class Policy(Enum):
    """Which links a packet of video goes over."""

    COPY = "copy"
    """All: what one loses, another brings."""
    SHARE = "share"
    """One, in turn, as much as each carries: more bandwidth."""


@dataclass(frozen=True)
class LinkState:
    """How a link is.

    Attributes:
        up: something came by it within the last second, and answers do.
        local, remote: addresses, HOST:PORT.
        round_trip_ms: the last ones' mean; NaN: unknown.
        loss, loss_there: of what was sent to us, and, as the peer tells, to it; 0 to 1.
        bytes_in, bytes_out: messages and video, since the beginning.
        handshake_s: how long the last handshake took; renewed: how many followed the first.
        cipher: version, cipher and group of the encryption.
        why: it is down, as far as we know.
    """

    name: str
    up: bool = False
    local: str = ""
    remote: str = ""
    round_trip_ms: float = float("nan")
    loss: float = 0.0
    loss_there: float = 0.0
    bytes_in: int = 0
    bytes_out: int = 0
    handshake_s: float = float("nan")
    renewed: int = 0
    cipher: str = ""
    why: str = ""


@dataclass
class Carrier:
    """An association, and what carries its datagrams and video."""

    name: str
    association: Association
    media: Callable[[bytes], None]
    local: str
    remote: str
    pinged: OrderedDict[int, int] = field(default_factory=OrderedDict)
    pings: int = 0
    cipher: str = ""
    next_ping: float = 0.0
    answered: float = 0.0
    trip: float = float("nan")
    least: float = float("inf")
    loss_there: float = 0.0
    share: float = 1.0
    used: float = 0.0

    def up(self, now: float) -> bool:
        """Whether it works, both ways."""
        one = self.association
        if one.ended or one.established is None or now - one.heard >= SILENT:
            return False
        return now - max(self.answered, one.established) < UNANSWERED


@dataclass
class _Line:
    """A link over its carriers' lives."""

    carrier: Carrier | None = None
    bytes_in: int = 0
    bytes_out: int = 0
    associations: int = 0
    why: str = ""


class Bundle:
    """All links to a peer. `send`, `send_media`, `links`, `counts` and `close` are any thread's.

    Args:
        received: is given each message once, as it comes, in the receiving thread; must not block.
        media: is given each packet of video with its link's name, likewise.
        began: is told, likewise, that the peer has (re)started: its numbers begin at 0.
        closing: what `close` does.

    Attributes:
        clocks: the peer's against ours.
        counter: what `counts` tells, as it grows.
    """

    def __init__(
        self,
        received: Callable[[Message], None],
        media: Callable[[bytes, str], None],
        began: Callable[[], None] = lambda: None,
        *,
        clocks: Clocks | None = None,
        closing: Callable[[], None] = lambda: None,
    ) -> None:
        self.clocks = clocks or Clocks()
        self.counter: Counter[str] = Counter()
        self._received, self._media, self._began, self._closing = received, media, began, closing
        self._session = secrets.token_bytes(SESSION)
        self._lock = threading.Lock()
        self._number = 0
        self._lines: dict[str, _Line] = {}
        self._sending: tuple[Carrier, ...] = ()
        self._window = Window()
        self._theirs, self._since = b"", float("-inf")

    @property
    def counts(self) -> Mapping[str, int]:
        """What wasn't taken so far, by why."""
        return dict(self.counter)

    @property
    def links(self) -> tuple[LinkState, ...]:
        """All links, also those that are down."""
        return tuple(self._state(name, line) for name, line in list(self._lines.items()))

    @property
    def round_trip(self) -> float:
        """Seconds there and back by the quickest link that is up; NaN: unknown."""
        now = time.monotonic()
        return min((one.trip for one in self._sending if one.up(now) and one.trip == one.trip), default=float("nan"))

    def send(self, kind: Kind, body: bytes) -> int:
        """A message to the peer, over all links there are; never blocks.

        Returns:
            Its number.

        Raises:
            ValueError: it is too long.
        """
        if len(body) > LARGEST - HEADER.size:
            raise ValueError(f"a message of {len(body)} bytes")
        with self._lock:
            number, self._number = self._number, self._number + 1
        data = self._packed(kind, number, body)
        for carrier in self._sending:
            self._put(carrier, data)
        return number

    def send_media(self, packet: bytes, policy: Policy = Policy.COPY) -> None:
        """A packet of video, over links that are up; never blocks."""
        now = time.monotonic()
        carriers = [one for one in self._sending if one.up(now)]
        if policy == Policy.SHARE and carriers:
            carriers = [min(carriers, key=lambda one: one.used)]
            carriers[0].used += len(packet) / carriers[0].share
        for carrier in carriers:
            carrier.media(packet)
            self._lines[carrier.name].bytes_out += len(packet)

    def close(self) -> None:
        """End all links."""
        self._closing()

    # what follows is for `dialling` and `listening`, in the receiving thread

    def known(self, name: str, why: str = "") -> None:
        """There is such a link; why it is down."""
        self._lines.setdefault(name, _Line()).why = why

    def attach(self, carrier: Carrier) -> Carrier | None:
        """A link's newest carrier, which is sent over from now on; the one before it, if there was one."""
        line = self._lines.setdefault(carrier.name, _Line())
        before, line.carrier, line.why = line.carrier, carrier, ""
        line.associations += 1
        carrier.cipher = " ".join(carrier.association.agreed.values())
        self._look()
        return before

    def detach(self, carrier: Carrier) -> None:
        """A carrier has ended."""
        line = self._lines.get(carrier.name)
        if line is not None and line.carrier is carrier:
            line.carrier, line.why = None, carrier.association.ended
            self._look()

    def full(self, name: str) -> bool:
        """Whether there are too many links for one of another name."""
        return name not in self._lines and len(self._lines) >= NAMES

    def packet(self, carrier: Carrier, data: bytes) -> None:
        """A packet of video came."""
        self._came(carrier, data)
        try:
            self._media(data, carrier.name)
        except Exception:  # what handles video must not end the links
            self._failed("video")

    def arrived(self, carrier: Carrier, data: bytes) -> None:
        """A message came, as the association has opened it."""
        self._came(carrier, data)
        try:
            message = Message.unpack(data[SESSION:])
            if not self._current(carrier, data[:SESSION]):
                return
            if message.kind == Kind.PING:
                self._answer(carrier, message)
            elif message.kind == Kind.PONG:
                self._answered(carrier, message)
            elif refused := self._window.take(message.number):
                self.counter[refused] += 1
            else:
                self._received(message)
        except Malformed:
            self.counter["malformed"] += 1
        except Exception:  # what handles messages must not end the links
            self._failed("a message")

    def tick(self, now: float) -> None:
        """Ping what is due, and weigh the links."""
        for carrier in self._sending:
            carrier.association.tick(now)
            if now >= carrier.next_ping:
                self._ping(carrier, now)
        if self._sending:
            least = min(one.used for one in self._sending)
            for one in self._sending:
                one.used -= least

    def _state(self, name: str, line: _Line) -> LinkState:
        one, why = line.carrier, line.why
        if one is None:
            return LinkState(name, bytes_in=line.bytes_in, bytes_out=line.bytes_out, why=why)
        up = one.up(time.monotonic())
        hand = (one.association.established or one.association.began) - one.association.began
        return LinkState(
            name, up, one.local, one.remote, one.trip * 1e3, one.association.loss, one.loss_there, line.bytes_in,
            line.bytes_out, hand, line.associations - 1, one.cipher, "" if up else why or "nothing comes",
        )  # fmt: skip

    def _packed(self, kind: Kind, number: int, body: bytes) -> bytes:
        return self._session + Message(kind, number, self.clocks.monotonic(), body).pack()

    def _put(self, carrier: Carrier, data: bytes) -> None:
        if carrier.association.send(data):
            self._lines[carrier.name].bytes_out += len(data)

    def _came(self, carrier: Carrier, data: bytes) -> None:
        if (line := self._lines.get(carrier.name)) is not None:
            line.bytes_in += len(data)

    def _look(self) -> None:
        self._sending = tuple(line.carrier for line in self._lines.values() if line.carrier is not None)
        for one in self._sending:  # a new one takes its share of what follows, not all of it
            one.used = max(each.used for each in self._sending)

    def _current(self, carrier: Carrier, session: bytes) -> bool:
        """Whether a message is of the peer's present session, which may have begun with it."""
        if session == self._theirs:
            return True
        born = carrier.association.established or 0.0
        if born <= self._since:
            self.counter["stale"] += 1
            return False
        self._theirs, self._since = session, born
        self._window = Window()
        self.clocks.forget()
        self._began()
        return True

    def _ping(self, carrier: Carrier, now: float) -> None:
        carrier.next_ping = now + (QUICK if carrier.pings < QUICKLY else PING)
        data = self._packed(Kind.PING, carrier.pings, carrier.name.encode())
        carrier.pinged[carrier.pings] = Message.unpack(data[SESSION:]).sent
        if len(carrier.pinged) > 64:
            carrier.pinged.popitem(last=False)
        carrier.pings += 1
        self._put(carrier, data)

    def _answer(self, carrier: Carrier, ping: Message) -> None:
        noticed = self.clocks.monotonic()
        body = _PONG.pack(ping.sent, noticed, self.clocks.wall(), carrier.association.loss)
        self._put(carrier, self._packed(Kind.PONG, ping.number, body))

    def _answered(self, carrier: Carrier, pong: Message) -> None:
        heard = self.clocks.monotonic()
        if (asked := carrier.pinged.pop(pong.number, None)) is None:
            return
        try:
            _, noticed, wall, loss = _PONG.unpack(pong.body)
        except struct.error as error:
            raise Malformed(str(error)) from None
        self.clocks.exchanged(asked, noticed, pong.sent, heard, wall)
        carrier.answered = time.monotonic()
        trip = ((heard - asked) - (pong.sent - noticed)) / 1e9
        carrier.trip = trip if carrier.trip != carrier.trip else 0.8 * carrier.trip + 0.2 * trip
        carrier.least = min(carrier.least, carrier.trip)
        carrier.loss_there = min(1.0, max(0.0, loss)) if loss == loss else 1.0
        full = carrier.loss_there > _BAD_LOSS or carrier.trip > carrier.least + _BAD_DELAY
        carrier.share = max(_LEAST, carrier.share * _SHRINK) if full else min(1.0, carrier.share * _GROW)

    def _failed(self, what: str) -> None:
        self.counter["failed"] += 1
        if self.counter["failed"] in (1, 10, 100, 1000):
            log.exception("%s could not be handled", what)
