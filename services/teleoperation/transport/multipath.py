"""Multipath connection: all links to a peer as one. Every message goes over all links; the first copy is accepted.

The connection uses no sockets: `vehicle_side` and `station_side` attach link sessions (one DTLS session each), and pass
on what they receive. A datagram contains the sender's session, then the message: a peer that restarts counts its
messages from 0 again, and has another session.
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

from scan2sim.services.teleoperation.control.messages import HEADER, MESSAGE_MAX_BYTES, Kind, Malformed, Message
from scan2sim.services.teleoperation.transport.clock_sync import ClockSync
from scan2sim.services.teleoperation.transport.dedup_window import DedupWindow
from scan2sim.services.teleoperation.transport.dtls_session import DtlsSession

log = logging.getLogger(__name__)

RECEIVE_TIMEOUT_S, PONG_TIMEOUT_S = 1.0, 2.0
"""Silence of the peer, and time without an answer to pings, after which a link counts as down."""
PING_PERIOD_S, FIRST_PING_PERIOD_S, FIRST_PINGS = 0.2, 0.05, 8
"""Interval between pings of a link; interval of the first ones, and their number."""
LINKS_MAX = 16
"""Maximum number of links to a peer."""
SESSION_BYTES = 4
"""Length of the sender's session before each message."""
_PONG = struct.Struct("<qqqf")  # times of sending and receiving the ping, wall clock, loss
_SHARE_DECREASE, _SHARE_INCREASE, _SHARE_MIN = 0.7, 1.05, 0.05  # of a link's share of video, at each answered ping
_CONGESTION_LOSS, _CONGESTION_DELAY_S = 0.02, 0.1  # thresholds of loss, and of delay above the minimum round trip


class Policy(Enum):
    """Which links a video packet goes over."""

    COPY = "copy"
    """All links, for redundancy."""
    SHARE = "share"
    """One link in turn, in proportion to what each carries, for bandwidth."""


@dataclass(frozen=True)
class LinkState:
    """State of a link.

    Attributes:
        up: something was received within the last second, and pings are answered.
        local, remote: addresses, HOST:PORT.
        round_trip_ms: moving average; NaN: unknown.
        loss, loss_there: share lost of what was sent to us, and, as the peer reports, to the peer; 0 to 1.
        bytes_in, bytes_out: total of messages and video.
        handshake_s: duration of the last handshake; renewed: number of handshakes after the first.
        cipher: version, cipher and group of the encryption.
        why: reason for which the link is down, if known.
        silent_s: seconds since anything was received over it; NaN: it has no session.
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
    silent_s: float = float("nan")


@dataclass
class LinkSession:
    """A DTLS session on a link, with its ping state; `media` sends a video packet."""

    name: str
    dtls: DtlsSession
    media: Callable[[bytes], None]
    local: str
    remote: str
    pinged: OrderedDict[int, int] = field(default_factory=OrderedDict)
    pings: int = 0
    cipher: str = ""
    next_ping: float = 0.0
    last_pong: float = 0.0
    round_trip: float = float("nan")
    min_round_trip: float = float("inf")
    loss_there: float = 0.0
    share: float = 1.0
    weighted_bytes: float = 0.0

    def up(self, now: float) -> bool:
        """Whether the link works in both directions."""
        one = self.dtls
        if one.ended or one.established is None or now - one.last_received >= RECEIVE_TIMEOUT_S:
            return False
        return now - max(self.last_pong, one.established) < PONG_TIMEOUT_S


@dataclass
class _LinkHistory:
    """State of a link over all of its sessions."""

    session: LinkSession | None = None
    bytes_in: int = 0
    bytes_out: int = 0
    sessions: int = 0
    why: str = ""


class MultipathConnection:
    """All links to a peer. `send`, `send_media`, `links`, `counts` and `close` are thread-safe.

    Args:
        received: called once for each message, on arrival, in the receiving thread; must not block.
        media: called likewise for each video packet, with the name of its link.
        restarted: called likewise when the peer has started or restarted: its message numbers begin at 0.
        on_close: called by `close`.
        clock: current time, seconds; the same as that of the times passed to `tick` and to sessions.

    Attributes:
        clocks: offset of the peer's clocks.
        counter: the counts of `counts`, as they grow.
    """

    def __init__(
        self,
        received: Callable[[Message], None],
        media: Callable[[bytes, str], None],
        restarted: Callable[[], None] = lambda: None,
        *,
        clocks: ClockSync | None = None,
        on_close: Callable[[], None] = lambda: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._clock = clock
        self.clocks = clocks or ClockSync()
        self.counter: Counter[str] = Counter()
        self._received, self._media, self._restarted, self._on_close = received, media, restarted, on_close
        self._session = secrets.token_bytes(SESSION_BYTES)
        self._lock = threading.Lock()
        self._number = 0
        self._links: dict[str, _LinkHistory] = {}
        self._sending: tuple[LinkSession, ...] = ()
        self._window = DedupWindow()
        self._peer_session, self._peer_session_since = b"", float("-inf")

    @property
    def counts(self) -> Mapping[str, int]:
        """Number of dropped messages and packets, by reason."""
        return dict(self.counter)

    @property
    def links(self) -> tuple[LinkState, ...]:
        """States of all links, including those that are down."""
        return tuple(self._state(name, link) for name, link in list(self._links.items()))

    @property
    def round_trip(self) -> float:
        """Round-trip time of the fastest link that is up, seconds; NaN: unknown."""
        now = self._clock()
        return min(
            (one.round_trip for one in self._sending if one.up(now) and one.round_trip == one.round_trip),
            default=float("nan"),
        )

    def send(self, kind: Kind, body: bytes) -> int:
        """Send a message over all links; never blocks.

        Returns:
            The message number.

        Raises:
            ValueError: the message is too long.
        """
        if len(body) > MESSAGE_MAX_BYTES - HEADER.size:
            raise ValueError(f"a message body of {len(body)} bytes is too long")
        with self._lock:
            number, self._number = self._number, self._number + 1
        data = self._encode(kind, number, body)
        for session in self._sending:
            self._send(session, data)
        return number

    def send_media(self, packet: bytes, policy: Policy = Policy.COPY) -> None:
        """Send a video packet over links that are up; never blocks."""
        now = self._clock()
        sessions = [one for one in self._sending if one.up(now)]
        if policy == Policy.SHARE and sessions:
            sessions = [min(sessions, key=lambda one: one.weighted_bytes)]
            sessions[0].weighted_bytes += len(packet) / sessions[0].share
        for session in sessions:
            session.media(packet)
            self._links[session.name].bytes_out += len(packet)

    def close(self) -> None:
        """Close all links."""
        self._on_close()

    # for `vehicle_side` and `station_side`, in the receiving thread

    def report_down(self, name: str, why: str = "") -> None:
        """Set why a link is down; adds the link if it is new."""
        self._links.setdefault(name, _LinkHistory()).why = why

    def attach(self, session: LinkSession) -> LinkSession | None:
        """Send over this session from now on; returns the link's previous session, if any."""
        link = self._links.setdefault(session.name, _LinkHistory())
        before, link.session, link.why = link.session, session, ""
        link.sessions += 1
        session.cipher = " ".join(session.dtls.negotiated.values())
        self._update_sessions()
        return before

    def detach(self, session: LinkSession) -> None:
        """Stop using a session that has ended."""
        link = self._links.get(session.name)
        if link is not None and link.session is session:
            link.session, link.why = None, session.dtls.ended
            self._update_sessions()

    def is_full(self, name: str) -> bool:
        """Whether there is no room for a link of another name."""
        return name not in self._links and len(self._links) >= LINKS_MAX

    def receive_media(self, session: LinkSession, data: bytes) -> None:
        """Process a video packet."""
        self._count_received(session, data)
        try:
            self._media(data, session.name)
        except Exception:  # errors of the video callback must not end the links
            self._log_failure("video")

    def receive_message(self, session: LinkSession, data: bytes) -> None:
        """Process a decrypted message."""
        self._count_received(session, data)
        try:
            message = Message.unpack(data[SESSION_BYTES:])
            if not self._is_current(session, data[:SESSION_BYTES]):
                return
            if message.kind == Kind.PING:
                self._answer_ping(session, message)
            elif message.kind == Kind.PONG:
                self._handle_pong(session, message)
            elif drop_reason := self._window.add(message.number):
                self.counter[drop_reason] += 1
            else:
                self._received(message)
        except Malformed:
            self.counter["malformed"] += 1
        except Exception:  # errors of the message callback must not end the links
            self._log_failure("a message")

    def tick(self, now: float) -> None:
        """Send pings that are due, and rebalance the links."""
        for session in self._sending:
            session.dtls.tick(now)
            if now >= session.next_ping:
                self._ping(session, now)
        if self._sending:
            minimum = min(one.weighted_bytes for one in self._sending)
            for one in self._sending:
                one.weighted_bytes -= minimum

    def _state(self, name: str, link: _LinkHistory) -> LinkState:
        one, why = link.session, link.why
        if one is None:
            return LinkState(name, bytes_in=link.bytes_in, bytes_out=link.bytes_out, why=why)
        now = self._clock()
        up = one.up(now)
        handshake = (one.dtls.established or one.dtls.started) - one.dtls.started
        return LinkState(
            name, up, one.local, one.remote, one.round_trip * 1e3, one.dtls.loss, one.loss_there, link.bytes_in,
            link.bytes_out, handshake, link.sessions - 1, one.cipher, "" if up else why or "nothing is received",
            now - one.dtls.last_received,
        )  # fmt: skip

    def _encode(self, kind: Kind, number: int, body: bytes) -> bytes:
        return self._session + Message(kind, number, self.clocks.monotonic(), body).pack()

    def _send(self, session: LinkSession, data: bytes) -> None:
        if session.dtls.send(data):
            self._links[session.name].bytes_out += len(data)

    def _count_received(self, session: LinkSession, data: bytes) -> None:
        if (link := self._links.get(session.name)) is not None:
            link.bytes_in += len(data)

    def _update_sessions(self) -> None:
        self._sending = tuple(link.session for link in self._links.values() if link.session is not None)
        for one in self._sending:  # a new session gets a share of the traffic from now on, not all of it
            one.weighted_bytes = max(each.weighted_bytes for each in self._sending)

    def _is_current(self, session: LinkSession, peer_session: bytes) -> bool:
        """Whether a message belongs to the peer's current session; a newer one replaces it."""
        if peer_session == self._peer_session:
            return True
        established = session.dtls.established or 0.0
        if established <= self._peer_session_since:
            self.counter["stale"] += 1
            return False
        self._peer_session, self._peer_session_since = peer_session, established
        self._window = DedupWindow()
        self.clocks.reset()
        self._restarted()
        return True

    def _ping(self, session: LinkSession, now: float) -> None:
        session.next_ping = now + (FIRST_PING_PERIOD_S if session.pings < FIRST_PINGS else PING_PERIOD_S)
        data = self._encode(Kind.PING, session.pings, session.name.encode())
        session.pinged[session.pings] = Message.unpack(data[SESSION_BYTES:]).sent
        if len(session.pinged) > 64:
            session.pinged.popitem(last=False)
        session.pings += 1
        self._send(session, data)

    def _answer_ping(self, session: LinkSession, ping: Message) -> None:
        ping_received = self.clocks.monotonic()
        body = _PONG.pack(ping.sent, ping_received, self.clocks.wall(), session.dtls.loss)
        self._send(session, self._encode(Kind.PONG, ping.number, body))

    def _handle_pong(self, session: LinkSession, pong: Message) -> None:
        pong_received = self.clocks.monotonic()
        if (ping_sent := session.pinged.pop(pong.number, None)) is None:
            return
        try:
            _, ping_received, wall, loss = _PONG.unpack(pong.body)
        except struct.error as error:
            raise Malformed(str(error)) from None
        self.clocks.add_exchange(ping_sent, ping_received, pong.sent, pong_received, wall)
        session.last_pong = self._clock()
        round_trip = ((pong_received - ping_sent) - (pong.sent - ping_received)) / 1e9
        session.round_trip = (
            round_trip if session.round_trip != session.round_trip else 0.8 * session.round_trip + 0.2 * round_trip
        )
        session.min_round_trip = min(session.min_round_trip, session.round_trip)
        session.loss_there = min(1.0, max(0.0, loss)) if loss == loss else 1.0
        congested = (
            session.loss_there > _CONGESTION_LOSS or session.round_trip > session.min_round_trip + _CONGESTION_DELAY_S
        )
        session.share = (
            max(_SHARE_MIN, session.share * _SHARE_DECREASE) if congested else min(1.0, session.share * _SHARE_INCREASE)
        )

    def _log_failure(self, what: str) -> None:
        self.counter["failed"] += 1
        if self.counter["failed"] in (1, 10, 100, 1000):
            log.exception("%s could not be handled", what)
