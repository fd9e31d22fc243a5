"""How far a node's clock is off, by when its records come: for places in time, not for latencies (`clock_sync.py`).

Kafka's own times don't tell: a message bears its producer's, unless its topic is set up otherwise.
"""

from __future__ import annotations

from collections import deque

OFF = 2.0
"""Seconds by which a clock must be off to be told from records that took a while."""
RECORDS = 10
"""Records from which that is told."""
PACE = 0.5
"""Share of their periods over which these must have come: what waited for a broker comes in a rush."""


class Skew:
    """Of one node.

    Attributes:
        behind: seconds by which its clock is behind this machine's; negative: ahead; 0 within `OFF`, or not known yet.
    """

    def __init__(self) -> None:
        self._last: deque[tuple[float, float]] = deque(maxlen=RECORDS)
        self.behind = 0.0

    def add(self, came: float, told: float, period: float) -> float:
        """Take a record into account: when it came, by this machine's clock, and when it was told, by the node's.

        Returns:
            By how much `behind` has changed.
        """
        self._last.append((came, came - told))
        least = min(delay for _, delay in self._last)  # what came fastest shows most of the clock
        steady = len(self._last) == RECORDS and came - self._last[0][0] >= PACE * period * (RECORDS - 1)
        found = before = self.behind
        if least < min(before, -OFF):  # nothing comes before it was told
            found = least
        elif steady:
            found = least if abs(least) > OFF else 0.0
        if abs(found - before) > OFF / 2:
            self.behind = found
        return self.behind - before
