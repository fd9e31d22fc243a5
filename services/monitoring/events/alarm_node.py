"""A node that holds rules against what monitors tell, and sends alarms."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from scan2sim.services.monitoring.events import rules
from scan2sim.services.monitoring.events.bus import Bus
from scan2sim.services.monitoring.events.schema import RECORD, Alarm, QueueState
from scan2sim.services.monitoring.node.monitor import ros
from scan2sim.services.monitoring.settings.bus import AlarmsParams


class AlarmsNode(ros.Node):  # type: ignore[misc]
    """Watches the bus."""

    def __init__(self, params: AlarmsParams, tell: Callable[[Alarm], None], node_name: str = "alarms") -> None:
        """`tell` is called with every alarm, beside the bus."""
        self._alarms = rules.Alarms(rules.read(params.rules))
        super().__init__(node_name)
        self._bus = Bus(self, params, records=True)
        self._bus.events.on(RECORD, self._hold_record)
        self._bus.events.on("queue", self._hold_queue)
        self._bus.events.on("alarm", tell)
        self.create_timer(1.0, lambda: self._send(self._alarms.tick(time.time())))

    def _hold_record(self, record: Mapping[str, Any]) -> None:
        self._send(self._alarms.record(record))

    def _hold_queue(self, state: QueueState) -> None:
        self._send(self._alarms.queue(state, time.time()))

    def _send(self, alarms: list[Alarm]) -> None:
        for alarm in alarms:
            self._bus.events.send("alarm", alarm)

    def destroy_node(self) -> Any:
        """Leave the bus, and end."""
        self._bus.close()
        return super().destroy_node()
