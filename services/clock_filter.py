"""Offset of another machine's clock, from the four timestamps of each ping and its answer (NTP, RFC 5905)."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple


class Exchange(NamedTuple):
    """A ping and its answer, nanoseconds.

    Attributes:
        round_trip: without the other machine's processing time; half of it is the maximum error of `offset`.
        offset: the other clock minus ours, rounded down.
        at: our time when the answer arrived.
    """

    round_trip: int
    offset: int
    at: int

    @classmethod
    def of(cls, sent: int, received: int, answered: int, arrived: int) -> Exchange | None:
        """From t1 to t4 of RFC 5905, section 8; None: not valid timestamps, or a clock was set meanwhile.

        Args:
            sent, arrived: the ping's departure and the answer's arrival, by our clock.
            received, answered: the ping's arrival and the answer's departure, by the other clock.
        """
        round_trip = (arrived - sent) - (answered - received)
        if not 0 <= round_trip < 2**63 or answered < received:
            return None
        return cls(round_trip, ((received - sent) + (answered - arrived)) // 2, arrived)

    def uncertainty(self, now: int, drift: float = 0.0) -> float:
        """Maximum error of the offset at a time, nanoseconds; `drift`: of the two clocks, seconds per second."""
        return self.round_trip / 2 + drift * (now - self.at)


class ClockFilter:
    """Clock filter (RFC 5905, section 10): of the latest exchanges, the one with the least uncertainty counts.

    Args:
        size: number of exchanges kept.
        drift: maximum drift of the two clocks, seconds per second.

    Attributes:
        best: the exchange that counts; None: there is none.
    """

    def __init__(self, size: int, drift: float = 0.0) -> None:
        self.drift = drift
        self.best: Exchange | None = None
        self._latest: deque[Exchange] = deque(maxlen=size)

    def add(self, exchange: Exchange) -> Exchange:
        """Add the latest exchange; returns the one that counts."""
        self._latest.append(exchange)
        self.best = min(self._latest, key=lambda one: one.uncertainty(exchange.at, self.drift))
        return self.best

    @property
    def full(self) -> bool:
        """Whether as many exchanges are known as are kept."""
        return len(self._latest) == self._latest.maxlen
