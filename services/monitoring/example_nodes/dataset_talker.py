"""Dataset talker: replays a CSV file of messages, one line each: seconds from the start and size in bytes."""

from __future__ import annotations

import json
import time
from typing import Any

from scan2sim.services.monitoring.event_csv import read_events
from scan2sim.services.monitoring.node.monitor import STRING, Monitor, ros
from scan2sim.services.monitoring.settings.monitor import DatasetParams
from scan2sim.services.transport import QoS

TIMER_TOLERANCE_S = 0.001
"""A message is sent up to this long before it is due."""
MESSAGES_QOS = QoS(depth=1000)
"""Nothing is lost while a subscriber stalls for some seconds."""
DELIVERY_S = 10.0
"""Longest wait at the end until all subscribers have received the last messages."""


class DatasetTalker(Monitor):
    """Publishes messages at the times and with the sizes given in a CSV file."""

    def __init__(self, params: DatasetParams) -> None:
        self._events = read_events(params.data)
        super().__init__(params.name, **params.monitor_settings())
        self._speed, self._size_as_field = params.speed, params.size_as_field
        self._publisher = self.create_publisher(ros.message_type(STRING), params.topic, MESSAGES_QOS)
        self._subscribers = params.subscribers
        self._began: float | None = None
        self._next = next(self._events, None)
        self.create_timer(0.005, self._send_due)

    @property
    def finished(self) -> bool:
        """Whether all messages were sent."""
        return self._next is None

    def _send_due(self) -> None:
        if self._began is None:
            if self._publisher.get_subscription_count() < self._subscribers:
                return
            self._began = time.monotonic()
        now = (time.monotonic() - self._began) * self._speed
        while self._next is not None and self._next[0] <= now + TIMER_TOLERANCE_S:
            seconds, size = self._next
            data = json.dumps({"time": seconds, "size": size}) if self._size_as_field else "x" * size
            self._publisher.publish(ros.message(STRING, data=data))
            self._next = next(self._events, None)

    def destroy_node(self) -> Any:
        """Wait until all messages are delivered and destroy the node."""
        self._publisher.wait_for_all_acked(DELIVERY_S)
        return super().destroy_node()
