"""Talker: publishes strings of a fixed size at a fixed interval."""

from __future__ import annotations

from scan2sim.services.monitoring.node.monitor import STRING, Monitor, ros
from scan2sim.services.monitoring.settings.monitor import TalkerParams


class Talker(Monitor):
    """Publishes the same string periodically."""

    def __init__(self, params: TalkerParams) -> None:
        super().__init__(params.name, **params.monitor_settings())
        self._message = ros.message(STRING, data="x" * params.size)
        self._publisher = self.create_publisher(ros.message_type(STRING), params.topic, 10)
        self.create_timer(params.interval, self._publish)

    def _publish(self) -> None:
        self._publisher.publish(self._message)
