"""Autoscaler node: requests workers for every queue whose state is published on the bus."""

from __future__ import annotations

import json
import time
from typing import Any

from scan2sim.services.monitoring.autoscale.forecast import DAY, ScaledProfile, daily_profile
from scan2sim.services.monitoring.autoscale.policy import Scaler
from scan2sim.services.monitoring.event_csv import read_events
from scan2sim.services.monitoring.events.bus import Bus
from scan2sim.services.monitoring.events.schema import QueueState, WorkersWanted
from scan2sim.services.monitoring.node.monitor import ros
from scan2sim.services.monitoring.settings.bus import ScaleParams


class ScalerNode(ros.Node):  # type: ignore[misc]
    """Decides on the number of workers at every published state of a queue."""

    def __init__(self, params: ScaleParams, node_name: str = "scaler") -> None:
        self._params, self._scalers = params, dict[str, Scaler]()
        history = ((seconds, 1) for seconds, _ in read_events(params.history)) if params.history else None
        self._usual = daily_profile(history) if history else None
        self._new_scaler()  # raises for contradictory limits, before the node is created
        super().__init__(node_name)
        if params.log_file:
            params.log_file.parent.mkdir(parents=True, exist_ok=True)
        self._log = params.log_file.open("a", buffering=1) if params.log_file else None
        self._bus = Bus(self, params)
        self._bus.events.on("queue", self._decide)
        self._bus.start()

    def _new_scaler(self) -> Scaler:
        return Scaler(self._params, ScaledProfile(self._params.window, self._usual) if self._usual else None)

    def _decide(self, state: QueueState) -> None:
        scaler = self._scalers.get(state.queue) or self._scalers.setdefault(state.queue, self._new_scaler())
        wanted = scaler.decide(_seconds_since_monday(), state.seconds, state.arrived, state.waiting)
        rate = scaler.forecast.predict(self._params.lead)
        if wanted != state.workers:
            request = WorkersWanted(queue=state.queue, workers=wanted, rate=rate, waiting=state.waiting)
            self._bus.events.send("workers", request)
        if self._log:
            self._log.write(
                json.dumps({"time": time.time(), "wanted": wanted, "rate": rate, **state.model_dump()}) + "\n"
            )

    def destroy_node(self) -> Any:
        """Leave the bus and destroy the node."""
        self._bus.close()
        if self._log:
            self._log.close()
        return super().destroy_node()


def _seconds_since_monday() -> float:
    """Seconds since midnight of some Monday, local time: 1970 began on a Thursday."""
    now = time.time()
    return now + time.localtime(now).tm_gmtoff - 4 * DAY
