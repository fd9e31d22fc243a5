"""Listens to a topic, and says what it heard."""

from __future__ import annotations

from typing import Any

from scan2sim.services.monitoring.node.monitor import STRING, Monitor, ros
from scan2sim.services.monitoring.settings.monitor import ListenerParams


class Listener(Monitor):
    """Hears strings."""

    def __init__(self, params: ListenerParams, node_name: str = "listener") -> None:
        super().__init__(node_name, **params.monitored())
        self.create_subscription(ros.message_type(STRING), params.topic, self._hear, 10)

    def _hear(self, message: Any) -> None:
        self.get_logger().info(f"I heard: {len(message.data)} chars")
