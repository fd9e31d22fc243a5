"""Clock synchronization: offset of a peer's clocks, measured continuously by pings over all links.

Timestamps are of the monotonic clock, which is never set (`services.clock_filter`). Wall clocks are compared as well,
since a difference shows that an NTP daemon doesn't work.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from scan2sim.services.clock_filter import ClockFilter, Exchange

SAMPLES_MAX = 64
"""Number of samples kept."""
DRIFT_MAX = 1e-4
"""Maximum drift of two clocks, seconds per second: twice the tolerance of common crystals."""
WALL_CLOCK_DIFFERENCE_MAX_S = 1.0
"""Difference between wall clocks above which one of them is wrong."""


class ClockSync:
    """Estimates the offset of a peer's clocks.

    Args:
        monotonic, wall: our clocks, nanoseconds.
    """

    def __init__(
        self, monotonic: Callable[[], int] = time.monotonic_ns, wall: Callable[[], int] = time.time_ns
    ) -> None:
        self.monotonic, self.wall = monotonic, wall
        self.reset()

    def reset(self) -> None:
        """Discard all samples: the peer has restarted, perhaps on another machine."""
        self._exchanges = ClockFilter(SAMPLES_MAX, DRIFT_MAX)
        self._wall_difference: float | None = None

    def add_exchange(self, ping_sent: int, ping_received: int, pong_sent: int, pong_received: int, wall: int) -> None:
        """Add the timestamps of a ping and its answer.

        Args:
            ping_sent, pong_received: by our monotonic clock.
            ping_received, pong_sent: by the peer's monotonic clock.
            wall: the peer's wall clock when it sent the pong.
        """
        exchange = Exchange.of(ping_sent, ping_received, pong_sent, pong_received)
        if exchange is None:
            return
        best, at = self._exchanges.best, exchange.at
        if best and abs(exchange.offset - best.offset) > exchange.uncertainty(at) + best.uncertainty(at, DRIFT_MAX):
            self.reset()  # one machine was suspended meanwhile, which stops its monotonic clock
        elapsed = self.monotonic() - (pong_sent - self._exchanges.add(exchange).offset)
        self._wall_difference = (wall - (self.wall() - elapsed)) / 1e9

    @property
    def known(self) -> bool:
        """Whether there is a sample."""
        return self._exchanges.best is not None

    @property
    def offset(self) -> float:
        """Peer's monotonic clock minus ours, seconds; NaN while unknown."""
        best = self._exchanges.best
        return best.offset / 1e9 if best else math.nan

    @property
    def uncertainty_ms(self) -> float:
        """Maximum error of `offset` and of ages, ms; infinite while unknown."""
        best = self._exchanges.best
        return best.uncertainty(self.monotonic(), DRIFT_MAX) / 1e6 if best else math.inf

    @property
    def wall_apart_s(self) -> float:
        """Peer's wall clock minus ours, seconds; NaN while unknown."""
        difference = self._wall_difference
        return math.nan if difference is None else difference

    @property
    def wall_wrong(self) -> bool:
        """Whether one of the two wall clocks is wrong; False while unknown."""
        return abs(self.wall_apart_s) - self.uncertainty_ms / 1e3 > WALL_CLOCK_DIFFERENCE_MAX_S

    def age_ms(self, sent: int) -> float:
        """Age of a timestamp of the peer's monotonic clock, ms; infinite while the offset is unknown."""
        best = self._exchanges.best
        return (self.monotonic() - sent + best.offset) / 1e6 if best else math.inf
