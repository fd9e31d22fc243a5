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
    """Last signs of the brokers and of their topics, and since when there have been such without an outage.

    All times are seconds since the epoch.
    """

    def __init__(self, started: float, records_topic: str, *topics: str) -> None:
        """Nothing is known yet.

        Args:
            started: when this program started; what was before is unknown.
            records_topic: on which records arrive.
            topics: others that this program reads.
        """
        self._last = self._began = self._reachable_since = started
        self._records_topic, self._was_assigned = records_topic, False
        self._last_assigned = dict.fromkeys((records_topic, *topics), started)

    def reached(self, now: float) -> None:
        """The brokers have given a sign of life: a message, or an answer."""
        if now - self._last > OUTAGE_S:
            self._began, self._reachable_since = max(self._began, now + RESEND_S), now
        self._last = now

    def assigned(self, topic: str, now: float) -> None:
        """The brokers answer and have assigned a topic to this program: its messages can arrive.

        Brokers that answer may need several seconds to assign a topic, for example after a kill of this program.
        """
        if topic == self._records_topic:
            if not self._was_assigned or now - self._last_assigned[topic] > OUTAGE_S:
                self._began = max(self._began, now)
            self._was_assigned = True
        self._last_assigned[topic] = now

    def unassigned(self) -> dict[str, float]:
        """Seconds for which the brokers have been answering without assigning a topic, for each topic."""
        return {
            topic: max(0.0, self._last - max(assigned, self._reachable_since))
            for topic, assigned in self._last_assigned.items()
        }

    def outage(self, now: float) -> float:
        """Seconds since the last sign; 0 while the brokers count as reachable."""
        seconds = now - self._last
        return seconds if seconds > OUTAGE_S else 0.0

    def silence(self, arrived: float, now: float) -> float:
        """Seconds for which a node has been silent, as far as that is known.

        Args:
            arrived: when its last record arrived. A node that was heard after the topic of records was last known to be
                assigned is heard on another way (ROS 2): its silence lasts until `now`.
            now: seconds since the epoch.
        """
        assigned = self._last_assigned[self._records_topic]
        until = now if arrived > assigned + TOLERANCE_S else assigned
        return max(0.0, until - max(arrived, self._began))


class NoBroker(BrokerContact):
    """Contact of a program that doesn't use Kafka: records arrive by ROS 2 alone."""

    def unassigned(self) -> dict[str, float]:
        """No topics."""
        return {}

    def outage(self, now: float) -> float:
        """No outage."""
        return 0.0

    def silence(self, arrived: float, now: float) -> float:
        """Seconds since the last record, or since this program started."""
        return max(0.0, now - max(arrived, self._began))
