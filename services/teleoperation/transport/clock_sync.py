"""Clock synchronization: offset of a peer's clocks, from the four timestamps of each ping and its answer (as in NTP).

Timestamps are of the monotonic clock, which is never set. The offset is measured continuously over all links; the
sample of least uncertainty is used: half its round trip, plus possible drift since. Wall clocks are compared as well,
since a difference shows that an NTP daemon doesn't work.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

SAMPLES_MAX = 64
"""Number of samples kept."""
DRIFT_MAX = 1e-4
"""Maximum drift of two clocks, seconds per second: twice the tolerance of common crystals."""
WALL_CLOCK_DIFFERENCE_MAX_S = 1.0
"""Difference between wall clocks above which one of them is wrong."""


@dataclass(frozen=True)
class Sample:
    """One exchange; nanoseconds.

    Attributes:
        offset: peer's monotonic clock minus ours.
        half: half the round trip, without the peer's processing time: maximum error of `offset`.
        at: time of our monotonic clock.
    """

    offset: float
    half: float
    at: int

    def uncertainty(self, now: int) -> float:
        """Maximum error of the offset at a time, nanoseconds."""
        return self.half + DRIFT_MAX * (now - self.at)


class ClockSync:
    """Estimates the offset of a peer's clocks.

    Args:
        monotonic, wall: our clocks, nanoseconds.
    """

    def __init__(
        self, monotonic: Callable[[], int] = time.monotonic_ns, wall: Callable[[], int] = time.time_ns
    ) -> None:
        self.monotonic, self.wall = monotonic, wall
        self._samples: deque[Sample] = deque(maxlen=SAMPLES_MAX)
        self._best: Sample | None = None
        self._wall_difference: float | None = None

    def reset(self) -> None:
        """Discard all samples: the peer has restarted, perhaps on another machine."""
        self._samples.clear()
        self._best = self._wall_difference = None

    def add_exchange(self, ping_sent: int, ping_received: int, pong_sent: int, pong_received: int, wall: int) -> None:
        """Add the timestamps of a ping and its answer.

        Args:
            ping_sent, pong_received: by our monotonic clock.
            ping_received, pong_sent: by the peer's monotonic clock.
            wall: the peer's wall clock when it sent the pong.
        """
        round_trip = (pong_received - ping_sent) - (pong_sent - ping_received)
        if round_trip < 0 or pong_sent < ping_received:  # not valid timestamps
            return
        sample = Sample(((ping_received - ping_sent) + (pong_sent - pong_received)) / 2, round_trip / 2, pong_received)
        if self._best is not None and abs(sample.offset - self._best.offset) > sample.half + self._best.uncertainty(
            pong_received
        ):
            self.reset()  # one machine was suspended meanwhile, which stops its monotonic clock
        self._samples.append(sample)
        self._best = min(self._samples, key=lambda one: one.uncertainty(pong_received))
        elapsed = self.monotonic() - (pong_sent - self._best.offset)
        self._wall_difference = (wall - (self.wall() - elapsed)) / 1e9

    @property
    def known(self) -> bool:
        """Whether there is a sample."""
        return self._best is not None

    @property
    def offset(self) -> float:
        """Peer's monotonic clock minus ours, seconds; NaN while unknown."""
        best = self._best
        return best.offset / 1e9 if best else math.nan

    @property
    def uncertainty_ms(self) -> float:
        """Maximum error of `offset` and of ages, ms; infinite while unknown."""
        best = self._best
        return best.uncertainty(self.monotonic()) / 1e6 if best else math.inf

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
        best = self._best
        return (self.monotonic() - sent + best.offset) / 1e6 if best else math.inf
