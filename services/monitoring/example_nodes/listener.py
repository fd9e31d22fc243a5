"""Listener: subscribes to strings on a topic and logs each message's size."""

from __future__ import annotations

from typing import Any

from scan2sim.services.monitoring.node.monitor import STRING, Monitor, ros
from scan2sim.services.monitoring.settings.monitor import ListenerParams


class Listener(Monitor):
    """Logs the size of each received string."""

    def __init__(self, params: ListenerParams, node_name: str = "listener") -> None:
        super().__init__(node_name, **params.monitor_settings())
        self.create_subscription(ros.message_type(STRING), params.topic, self._on_message, 10)

    def _on_message(self, message: Any) -> None:
        self.get_logger().info(f"received {len(message.data)} characters")
