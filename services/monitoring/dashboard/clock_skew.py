"""Clock skew of a node, estimated from the arrival of its records: to place them in time, not for latencies.

Latencies use `clock_sync.py`. Kafka's timestamps are no help: by default they are the producer's.
"""

from __future__ import annotations

from collections import deque

SKEW_THRESHOLD_S = 2.0
"""Smaller skews are indistinguishable from transmission delays and count as 0."""
SKEW_WINDOW = 10
"""Number of latest records from which the skew is estimated."""
MIN_ARRIVAL_PACE = 0.5
"""The records of the window must arrive over this fraction of their periods: buffered ones arrive in a burst."""


class ClockSkew:
    """Clock skew of one node.

    Attributes:
        behind: seconds by which its clock is behind this machine's; negative: ahead; 0: below the threshold or unknown.
    """

    def __init__(self) -> None:
        self._last: deque[tuple[float, float]] = deque(maxlen=SKEW_WINDOW)
        self.behind = 0.0

    def add(self, arrived: float, created: float, period: float) -> float:
        """Update the estimate by a record's arrival, by this machine's clock, and its creation, by the node's clock.

        Returns:
            The change of `behind`.
        """
        self._last.append((arrived, arrived - created))
        min_delay = min(delay for _, delay in self._last)  # closest to the skew alone
        min_span = MIN_ARRIVAL_PACE * period * (SKEW_WINDOW - 1)
        steady = len(self._last) == SKEW_WINDOW and arrived - self._last[0][0] >= min_span
        found = before = self.behind
        if min_delay < min(before, -SKEW_THRESHOLD_S):  # nothing arrives before it was created
            found = min_delay
        elif steady:
            found = min_delay if abs(min_delay) > SKEW_THRESHOLD_S else 0.0
        if abs(found - before) > SKEW_THRESHOLD_S / 2:
            self.behind = found
        return self.behind - before
