"""A node that watches one topic from outside, whoever publishes on it (D3.2's `topic_monitor`)."""

from __future__ import annotations

import time
from collections.abc import Callable

from scan2sim.pipeline.errors import DataError
from scan2sim.services.monitoring.monitor import Monitor, ros
from scan2sim.services.monitoring.watched import TopicParams
from scan2sim.services.transport import QoS
from scan2sim.services.transport.names import qualified

MOST_COMPATIBLE = QoS(reliability="BEST_EFFORT", durability="VOLATILE", depth=100)
"""Takes what anybody offers."""


class TopicMonitor(Monitor):
    """Watches a topic; messages are counted as they come, and read by nobody."""

    def __init__(self, params: TopicParams) -> None:
        """Watch, if the type of messages is given; else `find` begins."""
        super().__init__("topic_monitor" + qualified(params.topic).replace("/", "_"), **params.monitored())
        self._topic = qualified(params.topic, self.get_namespace())
        if params.type:
            self._watch(params.type)

    def find(self, timeout: float, waiting: Callable[[str], None] = lambda _: None) -> None:
        """Wait until somebody publishes on the topic, and watch it; `waiting` is told what is waited for.

        Raises:
            DataError: nobody does for so many seconds.
            SettingError: messages of that type can't be read here.
        """
        end, told = time.monotonic() + timeout, False
        while time.monotonic() < end:
            kinds = self.topics().get(self._topic)
            if kinds:
                self._watch(kinds[0])
                return
            if not told:
                waiting(f"nobody publishes on {self._topic} yet")
                told = True
            ros.spin_once(self, 0.2)
        there = ", ".join(sorted(self.topics())) or "none"
        raise DataError(self._topic, f"nobody published on it for {timeout:g} s", f"Topics that are there: {there}")

    def _watch(self, type_name: str) -> None:
        self.create_subscription(ros.message_type(type_name), self._topic, _unread, MOST_COMPATIBLE, raw=True)


def _unread(_: bytes) -> None:
    """The message itself is of no interest."""
