"""One DTLS session with a peer: handshake, then messages; independent of what carries its datagrams.

Keys are renewed by another session from a socket of its own (`vehicle_side`), while this one continues; so there is no
gap between two keys.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable

from scan2sim.services.teleoperation.identity import Peer
from scan2sim.services.teleoperation.transport.tls import DATAGRAM_MAX_BYTES, Channel, TlsClosed, TlsError, datagrams

_RECORD_TYPES, _RECORD_VERSIONS = frozenset((20, 21, 22, 23)), (b"\xfe\xff", b"\xfe\xfd")
_CLIENT_HELLO = 1
LOSS_PERIOD_S = 1.0
"""Period over which loss is measured."""


def count_records(data: bytes) -> int:
    """Number of DTLS records in a datagram; 0: it is not DTLS."""
    count = start = 0
    while start < len(data):
        if data[start] not in _RECORD_TYPES or data[start + 1 : start + 3] not in _RECORD_VERSIONS:
            return 0
        start += 13 + int.from_bytes(data[start + 11 : start + 13], "big")
        count += 1
    return count if start == len(data) <= DATAGRAM_MAX_BYTES else 0


def is_hello(data: bytes) -> bool:
    """Whether a datagram starts a handshake (ClientHello)."""
    return (
        count_records(data) == 1
        and len(data) > 60
        and data[0] == 22
        and data[13] == _CLIENT_HELLO
        and data[3:5] == b"\0\0"
    )


class DtlsSession:
    """A DTLS session. `send` and `close` are thread-safe; all else is for the receiving thread.

    Args:
        channel: DTLS state machine.
        transmit: sends a datagram; must not block or raise.
        counts: receives the number of "malformed" and "replayed" datagrams.
        now: current time, seconds, of the clock that is used in all calls.

    Attributes:
        started, established, last_received: times of creation, completed handshake (or None), and last reception.
        ended: why it ended; empty: it is open.
        loss: share of received traffic that was lost, 0 to 1.
    """

    def __init__(self, channel: Channel, transmit: Callable[[bytes], None], counts: Counter[str], now: float) -> None:
        self.started = self.last_received = now
        self.established: float | None = None
        self.ended = ""
        self.loss = 0.0
        self.counts = counts
        self._channel, self._transmit = channel, transmit
        self._lock = threading.Lock()
        self._highest_record = self._received = 0
        self._loss_mark = (now, 0, 0)

    @property
    def peer(self) -> Peer | None:
        """The remote party, once established."""
        return self._channel.peer

    @property
    def negotiated(self) -> dict[str, str]:
        """Version, cipher and group of the encryption."""
        with self._lock:
            return self._channel.negotiated()

    def start_handshake(self, now: float) -> None:
        """Start a handshake as its client."""
        with self._lock:
            self._continue_handshake(now)

    def receive(self, data: bytes, now: float) -> list[bytes]:
        """Process a datagram; returns the messages in it."""
        if not (count := count_records(data)):
            self.counts["malformed"] += 1
            return []
        with self._lock:
            if self.ended:
                return []
            self._channel.put(data)
            if self.established is None:
                self._continue_handshake(now)
                return []
            return self._read(data, count, now)

    def send(self, data: bytes) -> bool:
        """Send a message; False: the session is not established, or has ended."""
        with self._lock:
            if self.ended or self.established is None:
                return False
            try:
                self._transmit(self._channel.encrypt_datagram(data))
            except TlsError as error:
                self.ended = str(error)
                return False
        return True

    def tick(self, now: float) -> None:
        """Retransmit lost handshake records; update the loss."""
        with self._lock:
            if (
                self.established is None
                and not self.ended
                and (wait := self._channel.retransmit_delay()) is not None
                and wait <= 0
            ):
                try:
                    self._channel.retransmit()
                except TlsError as error:
                    self.ended = str(error)
                self._flush()
            since, highest, received = self._loss_mark
            if now - since >= LOSS_PERIOD_S:
                if self._highest_record > highest:
                    lost = max(0.0, 1 - (self._received - received) / (self._highest_record - highest))
                    self.loss = 0.5 * self.loss + 0.5 * lost
                self._loss_mark = (now, self._highest_record, self._received)

    def close(self, reason: str = "closed here") -> None:
        """Close the session, and notify the peer."""
        with self._lock:
            if not self.ended and self.established is not None:
                self._channel.close()
                self._flush()
            self.ended = self.ended or reason

    def _continue_handshake(self, now: float) -> None:
        try:
            if self._channel.handshake():
                self.established = self.last_received = now
        except TlsError as error:
            self.ended = str(error)
        self._flush()

    def _read(self, data: bytes, count: int, now: float) -> list[bytes]:
        parts: list[bytes] = []
        try:
            while len(parts) < count and (part := self._channel.read()) is not None:
                parts.append(part)
        except TlsClosed:
            self.ended = "closed by the remote end"
        except TlsError as error:
            self.ended = str(error)
        if parts:
            self.last_received = now
            self._received += len(parts)
            self._highest_record = max(self._highest_record, int.from_bytes(data[5:11], "big"))
        elif data[0] == 22:
            self._flush()  # the peer lost our last handshake record, and requests it again
        elif not self.ended:
            self.counts["replayed"] += 1
        return parts

    def _flush(self) -> None:
        for data in datagrams(self._channel.take()):
            self._transmit(data)
