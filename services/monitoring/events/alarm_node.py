"""Alarm node: evaluates rules on monitoring records and queue states and publishes alarms."""

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
    """Evaluates alarm rules on everything that is published on the bus."""

    def __init__(self, params: AlarmsParams, notify: Callable[[Alarm], None], node_name: str = "alarms") -> None:
        """`notify` is called with every alarm, in addition to its publication on the bus."""
        self._evaluator = rules.RuleEvaluator(rules.read(params.rules))
        super().__init__(node_name)
        self._bus = Bus(self, params, records=True)
        self._bus.events.on(RECORD, self._check_record)
        self._bus.events.on("queue", self._check_queue)
        self._bus.events.on("alarm", notify)
        self.create_timer(1.0, lambda: self._send(self._evaluator.check_silence(time.time())))

    def _check_record(self, record: Mapping[str, Any]) -> None:
        self._send(self._evaluator.check_record(record))

    def _check_queue(self, state: QueueState) -> None:
        self._send(self._evaluator.check_queue(state, time.time()))

    def _send(self, alarms: list[Alarm]) -> None:
        for alarm in alarms:
            self._bus.events.send("alarm", alarm)

    def destroy_node(self) -> Any:
        """Leave the bus and destroy the node."""
        self._bus.close()
        return super().destroy_node()
