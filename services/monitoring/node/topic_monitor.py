"""A node that watches topics from outside, whoever publishes on them (D3.2's `topic_monitor`)."""

from __future__ import annotations

import time
from collections.abc import Callable

from scan2sim.pipeline.core.errors import DataError
from scan2sim.services.monitoring.node.monitor import Monitor, ros
from scan2sim.services.monitoring.settings.monitor import TopicParams
from scan2sim.services.transport import QoS
from scan2sim.services.transport.names import checked_type, qualified

LONGEST = 100
"""Characters of the node's name that are topics'."""
LOOKED = 1.0
"""Seconds between two looks for topics that weren't there."""


class TopicMonitor(Monitor):
    """Watches topics; messages are counted as they come, and read by nobody."""

    def __init__(self, params: TopicParams) -> None:
        """Watch, if the type of messages is given; else `find` begins."""
        topics = [qualified(topic) for topic in params.topics]
        super().__init__("topic_monitor" + "".join(topics).replace("/", "_")[:LONGEST], **params.monitored())
        self._depth, self._best_effort = params.depth, params.best_effort
        self._missing = list(dict.fromkeys(topics))
        if params.type:
            for topic in list(self._missing):
                self._watch(topic, checked_type(params.type))

    def find(self, timeout: float, waiting: Callable[[str], None] = lambda _: None) -> None:
        """Wait until somebody publishes on one of the topics, and watch it; the others are watched when they come.

        Args:
            timeout: seconds.
            waiting: is called with what is waited for, in words.

        Raises:
            DataError: nobody does for so many seconds.
            SettingError: messages of that type can't be read here.
        """
        topics, end = list(self._missing), time.monotonic() + timeout
        self._look()
        for topic in self._missing:
            waiting(f"nobody publishes on {topic} yet")
        while self._missing == topics and time.monotonic() < end:
            ros.spin_once(self, 0.2)
            self._look()
        if self._missing == topics:
            there = ", ".join(sorted(self.topics())) or "none"
            cause = f"nobody published on {'it' if len(topics) == 1 else 'them'} for {timeout:g} s"
            raise DataError(", ".join(topics), cause, f"Topics that are there: {there}")
        if self._missing:
            self.create_timer(LOOKED, self._look)

    def _look(self) -> None:
        if self._missing:
            there = self.topics()
            for topic in [one for one in self._missing if one in there]:
                self._watch(topic, there[topic][0])

    def _watch(self, topic: str, type_name: str) -> None:
        self._missing.remove(topic)
        self.create_subscription(self.raw_type(topic, type_name), topic, _unread, self._profile(topic), raw=True)

    def _profile(self, topic: str) -> QoS:
        """Reliable where all publishers are, as `ros2 topic hz` does: of large messages little comes by best effort."""
        offered = [one.qos.reliability for one in self.endpoints(topic) if one.kind == "PUBLISHER"]
        if offered and set(offered) == {"RELIABLE"} and not self._best_effort:
            return QoS(depth=self._depth)
        return QoS(reliability="BEST_EFFORT", depth=self._depth)


def _unread(_: bytes) -> None:
    """The message itself is of no interest."""
