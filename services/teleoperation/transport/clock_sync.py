"""How far a peer's clocks are off ours, by four timestamps: asked, noticed, answered, heard.

Stamps are of the monotonic clock, which nobody sets; the offset to a peer's is measured over all links, all the time,
and the sample of least uncertainty wins: half its round trip, and what crystals may have drifted since. Wall clocks are
compared beside that, since what they are wrong by tells of an NTP daemon that doesn't work.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

KEPT = 64
"""Samples that are looked at."""
DRIFT = 1e-4
"""Seconds a second that two clocks may drift apart: twice what crystals are sold with."""
APART = 1.0
"""Seconds between wall clocks above which one of them is wrong."""


@dataclass(frozen=True)
class Sample:
    """One exchange; nanoseconds.

    Attributes:
        offset: of the peer's monotonic clock from ours.
        half: of the round trip without the peer's own time: what `offset` may be wrong by.
        at: of our monotonic clock.
    """

    offset: float
    half: float
    at: int

    def uncertainty(self, now: int) -> float:
        """Nanoseconds."""
        return self.half + DRIFT * (now - self.at)


class Clocks:
    """Ours and a peer's.

    Args:
        monotonic, wall: our clocks, nanoseconds.
    """

    def __init__(
        self, monotonic: Callable[[], int] = time.monotonic_ns, wall: Callable[[], int] = time.time_ns
    ) -> None:
        self.monotonic, self.wall = monotonic, wall
        self._samples: deque[Sample] = deque(maxlen=KEPT)
        self._best: Sample | None = None
        self._apart: float | None = None

    def forget(self) -> None:
        """The peer has started anew: its clock may be another machine's."""
        self._samples.clear()
        self._best = self._apart = None

    def exchanged(self, asked: int, noticed: int, answered: int, heard: int, wall: int) -> None:
        """Learn from an exchange.

        Args:
            asked, heard: by our monotonic clock.
            noticed, answered: by the peer's.
            wall: the peer's wall clock when it answered.
        """
        trip = (heard - asked) - (answered - noticed)
        if trip < 0 or answered < noticed:  # whatever that is, it is no time
            return
        sample = Sample(((noticed - asked) + (answered - heard)) / 2, trip / 2, heard)
        if self._best is not None and abs(sample.offset - self._best.offset) > sample.half + self._best.uncertainty(
            heard
        ):
            self.forget()  # one machine slept meanwhile, which stops that clock
        self._samples.append(sample)
        self._best = min(self._samples, key=lambda one: one.uncertainty(heard))
        ago = self.monotonic() - (answered - self._best.offset)
        self._apart = (wall - (self.wall() - ago)) / 1e9

    @property
    def known(self) -> bool:
        """Whether there was an exchange."""
        return self._best is not None

    @property
    def offset(self) -> float:
        """Seconds that the peer's monotonic clock is ahead of ours; NaN while unknown."""
        best = self._best
        return best.offset / 1e9 if best else math.nan

    @property
    def uncertainty_ms(self) -> float:
        """Of `offset` and of ages; infinite while unknown."""
        best = self._best
        return best.uncertainty(self.monotonic()) / 1e6 if best else math.inf

    @property
    def wall_apart_s(self) -> float:
        """Seconds that the peer's wall clock is ahead of ours; NaN while unknown."""
        apart = self._apart
        return math.nan if apart is None else apart

    @property
    def wall_wrong(self) -> bool:
        """Whether one of the wall clocks is wrong; False while unknown."""
        return abs(self.wall_apart_s) - self.uncertainty_ms / 1e3 > APART

    def age_ms(self, sent: int) -> float:
        """How old a stamp of the peer's monotonic clock is; infinite while the offset is unknown."""
        best = self._best
        return (self.monotonic() - sent + best.offset) / 1e6 if best else math.inf
