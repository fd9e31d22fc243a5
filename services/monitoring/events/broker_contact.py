"""When Kafka was last there: a node's silence counts only while its records could have arrived."""

from __future__ import annotations

from scan2sim.services.outbox import MAX_RETRY_PAUSE_S

OUTAGE_S = 5.0
"""Time without a sign of the brokers after which they count as unreachable."""
RESEND_S = 2 * MAX_RETRY_PAUSE_S
"""Time after an outage until all nodes have sent their records again."""
TOLERANCE_S = 0.5
"""Tolerance of the comparison of a record's arrival with the sign of the brokers that belongs to it."""


class BrokerContact:
    """Last sign of the brokers, and since when there have been signs without an outage; seconds since the epoch."""

    def __init__(self, started: float) -> None:
        """`started`: when this program started; what was before is unknown."""
        self._last = self._began = started

    def reached(self, now: float) -> None:
        """The brokers have given a sign of life: a message, or an answer."""
        if now - self._last > OUTAGE_S:
            self._began = now + RESEND_S
        self._last = now

    def outage(self, now: float) -> float:
        """Seconds since the last sign; 0 while the brokers count as reachable."""
        seconds = now - self._last
        return seconds if seconds > OUTAGE_S else 0.0

    def silence(self, arrived: float, now: float) -> float:
        """Seconds for which a node has been silent, as far as that is known.

        Args:
            arrived: when its last record arrived. A node that was heard after the last sign of the brokers is heard on
                another way (ROS 2): its silence lasts until `now`.
            now: seconds since the epoch.
        """
        until = now if arrived > self._last + TOLERANCE_S else self._last
        return max(0.0, until - max(arrived, self._began))


class NoBroker(BrokerContact):
    """Contact of a program that doesn't use Kafka: records arrive by ROS 2 alone."""

    def outage(self, now: float) -> float:
        """No outage."""
        return 0.0

    def silence(self, arrived: float, now: float) -> float:
        """Seconds since the last record, or since this program started."""
        return max(0.0, now - max(arrived, self._began))
