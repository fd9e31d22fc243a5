"""One DTLS association with a peer: a handshake, then messages; whatever carries its datagrams.

Keys are renewed by another association beside this one (`dialling`), from a socket of its own, so that nothing is ever
between two keys.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable

from scan2sim.services.teleoperation.gateway.identity import Peer
from scan2sim.services.teleoperation.transport.tls import DATAGRAM, Channel, Ended, Refused, datagrams

_KINDS, _VERSIONS = frozenset((20, 21, 22, 23)), (b"\xfe\xff", b"\xfe\xfd")
_HELLO = 1
LOSS_OVER = 1.0
"""Seconds that loss is counted over."""


def records(data: bytes) -> int:
    """How many DTLS records a datagram holds; 0: it is something else."""
    count = start = 0
    while start < len(data):
        if data[start] not in _KINDS or data[start + 1 : start + 3] not in _VERSIONS:
            return 0
        start += 13 + int.from_bytes(data[start + 11 : start + 13], "big")
        count += 1
    return count if start == len(data) <= DATAGRAM else 0


def is_hello(data: bytes) -> bool:
    """Whether a datagram begins a handshake."""
    return records(data) == 1 and len(data) > 60 and data[0] == 22 and data[13] == _HELLO and data[3:5] == b"\0\0"


class Association:
    """One with a peer. `send` and `close` are any thread's, the rest is the receiving thread's.

    Args:
        channel: its DTLS.
        transmit: puts a datagram onto the network; must not block or raise.
        counts: "malformed" and "replayed" datagrams are added there.
        now: by the clock that all calls are told, seconds.

    Attributes:
        began, established, heard: when; established is None until it is.
        ended: why; empty: it goes on.
        loss: of what was sent to us, 0 to 1.
    """

    def __init__(self, channel: Channel, transmit: Callable[[bytes], None], counts: Counter[str], now: float) -> None:
        self.began = self.heard = now
        self.established: float | None = None
        self.ended = ""
        self.loss = 0.0
        self.counts = counts
        self._channel, self._transmit = channel, transmit
        self._lock = threading.Lock()
        self._top = self._received = 0
        self._mark = (now, 0, 0)

    @property
    def peer(self) -> Peer | None:
        """Who is at the other end, once established."""
        return self._channel.peer

    @property
    def agreed(self) -> dict[str, str]:
        """Version, cipher and group of the encryption."""
        with self._lock:
            return self._channel.agreed()

    def dial(self, now: float) -> None:
        """Begin a handshake as its client."""
        with self._lock:
            self._shake(now)

    def receive(self, data: bytes, now: float) -> list[bytes]:
        """What a datagram says."""
        if not (count := records(data)):
            self.counts["malformed"] += 1
            return []
        with self._lock:
            if self.ended:
                return []
            self._channel.put(data)
            if self.established is None:
                self._shake(now)
                return []
            return self._read(data, count, now)

    def send(self, data: bytes) -> bool:
        """Send something, once established; False: it has ended."""
        with self._lock:
            if self.ended or self.established is None:
                return False
            try:
                self._transmit(self._channel.seal(data))
            except Refused as error:
                self.ended = str(error)
                return False
        return True

    def tick(self, now: float) -> None:
        """Send parts of the handshake again that were lost; count losses."""
        with self._lock:
            if (
                self.established is None
                and not self.ended
                and (wait := self._channel.timer()) is not None
                and wait <= 0
            ):
                try:
                    self._channel.expired()
                except Refused as error:
                    self.ended = str(error)
                self._flush()
            since, top, received = self._mark
            if now - since >= LOSS_OVER:
                if self._top > top:
                    lost = max(0.0, 1 - (self._received - received) / (self._top - top))
                    self.loss = 0.5 * self.loss + 0.5 * lost
                self._mark = (now, self._top, self._received)

    def close(self, why: str = "closed here") -> None:
        """End it, and tell the other end."""
        with self._lock:
            if not self.ended and self.established is not None:
                self._channel.close()
                self._flush()
            self.ended = self.ended or why

    def _shake(self, now: float) -> None:
        try:
            if self._channel.handshake():
                self.established = self.heard = now
        except Refused as error:
            self.ended = str(error)
        self._flush()

    def _read(self, data: bytes, count: int, now: float) -> list[bytes]:
        parts: list[bytes] = []
        try:
            while len(parts) < count and (part := self._channel.read()) is not None:
                parts.append(part)
        except Ended:
            self.ended = "the other end closed it"
        except Refused as error:
            self.ended = str(error)
        if parts:
            self.heard = now
            self._received += len(parts)
            self._top = max(self._top, int.from_bytes(data[5:11], "big"))
        elif data[0] == 22:
            self._flush()  # our last part of the handshake was lost, and is asked for
        elif not self.ended:
            self.counts["replayed"] += 1
        return parts

    def _flush(self) -> None:
        for data in datagrams(self._channel.take()):
            self._transmit(data)
