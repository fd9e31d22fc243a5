"""Clock offsets between machines, which latencies between machines are corrected by.

A node that receives a message of an unknown process pings it on a ROS 2 topic and estimates the offset
(`services.clock_filter`). Processes on one machine share a clock and are pinged once.
"""

from __future__ import annotations

import ctypes
import time
import uuid
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from scan2sim.services.clock_filter import ClockFilter, Exchange

TOPIC = "monitor_clock"
"""Topic of pings and replies, JSON in std_msgs/String."""
GID_PREFIX_BYTES = 12
"""Leading bytes of a GID that identify the process (DDS participant)."""
PING_INTERVAL_S = 5.0
"""Pause between two exchanges with another machine, once `EXCHANGE_WINDOW` exchanges are known."""
INITIAL_PING_INTERVAL_S = 1.0
"""Pause until then, and between two unanswered pings."""
MAX_UNANSWERED_PINGS = 10
"""Unanswered pings after which a process counts as not instrumented and is no longer pinged."""
EXCHANGE_WINDOW = 8
"""Latest exchanges, of which the one with the shortest round trip counts."""
CLOCK_JUMP_NS = 50_000_000
"""A larger change of the clock between two records is a jump, a smaller one drift."""


@dataclass
class _Peer:
    """Another process.

    Attributes:
        host: machine on which it runs; None until it replied.
        exchanges: the latest exchanges with it.
    """

    host: str | None = None
    pinged: float = float("-inf")
    unanswered: int = 0
    exchanges: ClockFilter = field(default_factory=lambda: ClockFilter(EXCHANGE_WINDOW))


class ClockSync:
    """Clock exchange protocol with other processes; its methods return the message to send, if any."""

    def __init__(self, host: str | None = None) -> None:
        """`host`: identifier of the machine; None: this machine's."""
        self._host = host or this_host()
        self._id = uuid.uuid4().hex
        self._own: bytes | None = None
        self._peers: dict[bytes, _Peer] = {}
        self._wall_minus_monotonic = _wall_minus_monotonic()

    def hello(self) -> dict[str, Any] | None:
        """Message by whose arrival this process learns its own GID prefix; None: already known."""
        return None if self._own else {"to": "", "from": self._id, "sent": 0}

    def ping(self, publisher: bytes) -> dict[str, Any] | None:
        """Ping for the process of a publisher; None: no ping is due."""
        prefix = publisher[:GID_PREFIX_BYTES]
        peer = self._peers.get(prefix)
        if peer is None:
            peer = self._peers[prefix] = _Peer()
        if peer.host == self._host or (peer.host is None and peer.unanswered >= MAX_UNANSWERED_PINGS):
            return None
        interval = PING_INTERVAL_S if peer.exchanges.full else INITIAL_PING_INTERVAL_S
        if time.monotonic() - peer.pinged < interval:
            return None
        peer.pinged, peer.unanswered = time.monotonic(), peer.unanswered + 1
        return {"to": prefix.hex(), "from": self._id, "sent": time.time_ns()}

    def handle(self, message: Mapping[str, Any], publisher: bytes, received: int) -> dict[str, Any] | None:
        """Process a message of `TOPIC` and return the reply to send, if any.

        Args:
            message: its fields; malformed messages are ignored.
            publisher: GID of its publisher.
            received: time of arrival, nanoseconds since the epoch.
        """
        try:
            if message["from"] == self._id:
                self._own = publisher[:GID_PREFIX_BYTES]
            elif "host" in message and message["to"] == self._id:
                self._add_exchange(publisher, message, received)
            elif self._own and message["to"] == self._own.hex():
                times = {"sent": int(message["sent"]), "received": received, "answered": time.time_ns()}
                return {"to": message["from"], "from": self._id, "host": self._host} | times
        except (KeyError, TypeError, ValueError, OverflowError):
            pass  # malformed, or another program's message
        return None

    def offset(self, publisher: bytes | None) -> tuple[int, int] | None:
        """Offset of a publisher's clock from this one and its uncertainty in nanoseconds; positive: it is ahead.

        None: unknown, because its process hasn't replied.
        """
        peer = self._peers.get(publisher[:GID_PREFIX_BYTES]) if publisher else None
        if peer and peer.host == self._host:
            return 0, 0
        best = peer.exchanges.best if peer else None
        return (best.offset, best.round_trip // 2) if best else None

    def detect_jump(self) -> float:
        """Seconds by which this machine's clock was set since the last call; a jump discards all known offsets."""
        difference = _wall_minus_monotonic()
        jump_ns, self._wall_minus_monotonic = difference - self._wall_minus_monotonic, difference
        if abs(jump_ns) < CLOCK_JUMP_NS:
            return 0.0
        self._peers = {}
        return jump_ns / 1e9

    def _add_exchange(self, publisher: bytes, message: Mapping[str, Any], arrived: int) -> None:
        exchange = Exchange.of(int(message["sent"]), int(message["received"]), int(message["answered"]), arrived)
        peer = self._peers.setdefault(publisher[:GID_PREFIX_BYTES], _Peer())
        peer.host, peer.unanswered = str(message["host"]), 0
        if exchange is not None:
            peer.exchanges.add(exchange)


def _wall_minus_monotonic() -> int:
    """Difference of both clocks in nanoseconds; they are read again if the thread was interrupted in between."""
    while True:
        before, wall, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        if after - before < CLOCK_JUMP_NS // 2:
            return wall - before


@cache
def this_host() -> str:
    """Identifier of this machine since its last boot."""
    boot = Path("/proc/sys/kernel/random/boot_id")
    return boot.read_text(encoding="utf-8").strip() if boot.exists() else f"{uuid.getnode():x}"


class _NtpTime(ctypes.Structure):
    _fields_ = (
        ("seconds", ctypes.c_long),
        ("microseconds", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("tai", ctypes.c_long),
        ("reserved", ctypes.c_long * 4),
    )


@cache
def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None)


def synchronised() -> bool | None:
    """Whether this machine's clock is synchronised by NTP or PTP according to the kernel; None: unknown."""
    try:
        return _libc().ntp_gettime(ctypes.byref(_NtpTime())) not in (-1, 5)  # TIME_ERROR
    except (AttributeError, OSError):
        return None
