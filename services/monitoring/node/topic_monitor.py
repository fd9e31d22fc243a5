"""Node that monitors topics of any publishers by subscribing to them (D3.2's `topic_monitor`)."""

from __future__ import annotations

import time
from collections.abc import Callable

from scan2sim.pipeline.core.errors import DataError
from scan2sim.services.monitoring.node.monitor import Monitor, ros
from scan2sim.services.monitoring.settings.monitor import TopicParams
from scan2sim.services.transport import QoS
from scan2sim.services.transport.names import checked_type, qualified

MAX_TOPIC_CHARS = 100
"""Characters of the topics' names that the node's name may hold."""
DISCOVERY_INTERVAL_S = 1.0
"""Pause between two checks whether missing topics have appeared."""


class TopicMonitor(Monitor):
    """Monitors topics; counts their messages without deserializing them."""

    def __init__(self, params: TopicParams) -> None:
        """Subscribe at once if the message type is given; otherwise `find` subscribes."""
        topics = [qualified(topic) for topic in params.topics]
        name = "topic_monitor" + "".join(topics).replace("/", "_")[:MAX_TOPIC_CHARS]
        super().__init__(name, **params.monitor_settings())
        self._depth, self._best_effort = params.depth, params.best_effort
        self._missing = list(dict.fromkeys(topics))
        if params.type:
            for topic in list(self._missing):
                self._subscribe(topic, checked_type(params.type))

    def find(self, timeout: float, waiting: Callable[[str], None] = lambda _: None) -> None:
        """Wait until one of the topics has a publisher and subscribe to it; later to the others when they appear.

        Args:
            timeout: seconds to wait.
            waiting: called with a progress message for each topic that is missing.

        Raises:
            DataError: none of the topics has a publisher within `timeout`.
            SettingError: the definition of the message type is missing here.
        """
        topics, end = list(self._missing), time.monotonic() + timeout
        self._discover()
        for topic in self._missing:
            waiting(f"waiting for a publisher on {topic}")
        while self._missing == topics and time.monotonic() < end:
            ros.spin_once(self, 0.2)
            self._discover()
        if self._missing == topics:
            available = ", ".join(sorted(self.topics())) or "none"
            raise DataError(", ".join(topics), f"no publisher within {timeout:g} s", f"Available topics: {available}")
        if self._missing:
            self.create_timer(DISCOVERY_INTERVAL_S, self._discover)

    def _discover(self) -> None:
        if self._missing:
            available = self.topics()
            for topic in [one for one in self._missing if one in available]:
                self._subscribe(topic, available[topic][0])

    def _subscribe(self, topic: str, type_name: str) -> None:
        self._missing.remove(topic)
        self.create_subscription(self.raw_type(topic, type_name), topic, _discard, self._profile(topic), raw=True)

    def _profile(self, topic: str) -> QoS:
        """Reliable if all publishers are, like `ros2 topic hz`: by best effort, many large messages are lost."""
        offered = [one.qos.reliability for one in self.endpoints(topic) if one.kind == "PUBLISHER"]
        if offered and set(offered) == {"RELIABLE"} and not self._best_effort:
            return QoS(depth=self._depth)
        return QoS(reliability="BEST_EFFORT", depth=self._depth)


def _discard(_: bytes) -> None:
    """The message is counted by `received`; its content isn't needed."""
