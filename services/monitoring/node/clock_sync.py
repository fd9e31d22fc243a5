"""How far other machines' clocks are from this one: without that, a latency between machines says nothing.

A node that hears from a process it doesn't know asks it for the time, on the bus itself, by four timestamps (RFC 5905,
section 8); what tells most is the exchange that took least. Processes of one machine share a clock, and are asked once.
"""

from __future__ import annotations

import ctypes
import time
import uuid
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

TOPIC = "monitor_clock"
"""Of pings and their answers, as JSON in std_msgs/String."""
PREFIX = 12
"""Bytes of a GID that are the process's."""
PING_EVERY = 5.0
"""Seconds between two exchanges with another machine, once `KEPT` of them are known."""
PING_AT_FIRST = 1.0
"""Seconds until then, and between two tries."""
TRIES = 10
"""Pings without an answer after which a process counts as one that doesn't answer (it isn't watched)."""
KEPT = 8
"""Exchanges of which the quickest counts."""
JUMP = 50_000_000
"""Nanoseconds by which a clock may drift between two records; more is a jump."""


@dataclass
class _Peer:
    """Another process.

    Attributes:
        host: the machine that it runs on, once it has said.
        exchanges: nanoseconds that they took, and by which its clock is ahead.
        best: nanoseconds by which it is ahead, and how far that may be off; None: unknown.
    """

    host: str | None = None
    pinged: float = float("-inf")
    tries: int = 0
    exchanges: deque[tuple[int, int]] = field(default_factory=lambda: deque(maxlen=KEPT))
    best: tuple[int, int] | None = None


class Clock:
    """Exchanges with other processes; what is to be sent is returned."""

    def __init__(self, host: str | None = None) -> None:
        """`host`: what machines differ by; None: this one's."""
        self._host = host or this_host()
        self._id = uuid.uuid4().hex
        self._own: bytes | None = None
        self._peers: dict[bytes, _Peer] = {}
        self._ticked = time.time_ns() - time.monotonic_ns()

    def hello(self) -> dict[str, Any] | None:
        """What to send so that this process hears by what prefix of GIDs it is known; None: it knows."""
        return None if self._own else {"to": "", "from": self._id, "sent": 0}

    def ping(self, publisher: bytes) -> dict[str, Any] | None:
        """What to ask the process of a publisher that a message came from; None: nothing now."""
        prefix = publisher[:PREFIX]
        peer = self._peers.get(prefix)
        if peer is None:
            peer = self._peers[prefix] = _Peer()
        if peer.host == self._host or (peer.host is None and peer.tries >= TRIES):
            return None
        if time.monotonic() - peer.pinged < (PING_EVERY if len(peer.exchanges) == KEPT else PING_AT_FIRST):
            return None
        peer.pinged, peer.tries = time.monotonic(), peer.tries + 1
        return {"to": prefix.hex(), "from": self._id, "sent": time.time_ns()}

    def heard(self, message: Mapping[str, Any], publisher: bytes, received: int) -> dict[str, Any] | None:
        """Take a message of `TOPIC`; returns the answer, if one is to be sent.

        Args:
            message: what isn't one is left.
            publisher: GID of who sent it.
            received: nanoseconds since the epoch.
        """
        try:
            if message["from"] == self._id:
                self._own = publisher[:PREFIX]
            elif "host" in message and message["to"] == self._id:
                self._exchanged(publisher, message, received)
            elif self._own and message["to"] == self._own.hex():
                times = {"sent": int(message["sent"]), "received": received, "answered": time.time_ns()}
                return {"to": message["from"], "from": self._id, "host": self._host} | times
        except (KeyError, TypeError, ValueError, OverflowError):
            pass  # somebody else's message
        return None

    def offset(self, publisher: bytes | None) -> tuple[int, int] | None:
        """By how many nanoseconds a publisher's clock is ahead of this one, and how far that may be off.

        None: unknown, as its process hasn't answered.
        """
        peer = self._peers.get(publisher[:PREFIX]) if publisher else None
        return peer.best if peer else None

    def jump(self) -> float:
        """Seconds by which this machine's clock was set since the last call; what was exchanged is forgotten."""
        ticked = time.time_ns() - time.monotonic_ns()
        jumped, self._ticked = ticked - self._ticked, ticked
        if abs(jumped) < JUMP:
            return 0.0
        self._peers = {}
        return jumped / 1e9

    def _exchanged(self, publisher: bytes, message: Mapping[str, Any], back: int) -> None:
        sent, there, answered = int(message["sent"]), int(message["received"]), int(message["answered"])
        peer = self._peers.setdefault(publisher[:PREFIX], _Peer())
        peer.host, peer.tries = str(message["host"]), 0
        peer.exchanges.append(((back - sent) - (answered - there), ((there - sent) + (answered - back)) // 2))
        delay, ahead = min(peer.exchanges)
        peer.best = (0, 0) if peer.host == self._host else (ahead, delay // 2)


@cache
def this_host() -> str:
    """What this machine, in this life of it, differs from others by."""
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
    """Whether NTP (or PTP) keeps this machine's clock, as its kernel says; None: it says nothing."""
    try:
        return _libc().ntp_gettime(ctypes.byref(_NtpTime())) not in (-1, 5)  # TIME_ERROR
    except (AttributeError, OSError):
        return None
