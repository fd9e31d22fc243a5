"""Toolbox as an instrumented ROS 2 node: subscribes to images, publishes JSON results (D3.2, figure 16)."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

from scan2sim.services.monitoring.events.bus import Bus
from scan2sim.services.monitoring.events.schema import QueueState
from scan2sim.services.monitoring.node.monitor import STRING, Monitor, ros
from scan2sim.services.monitoring.settings.bus import BusParams
from scan2sim.services.toolboxes.engine import Engine
from scan2sim.services.toolboxes.frames import Frame, Raw
from scan2sim.services.toolboxes.results import Result, State
from scan2sim.services.toolboxes.settings import COMPRESSED, IMAGE, NodeParams
from scan2sim.services.transport import QoS
from scan2sim.services.transport.names import qualified

IMAGES_QOS = QoS(reliability="BEST_EFFORT", durability="VOLATILE", depth=2)
"""Compatible with every publisher; keeps only the latest images."""
RESULTS_QOS = QoS(depth=100)
UNPUBLISHED_STATES = (State.DROPPED, State.LATE)
"""States whose results are only counted, not published."""


class ToolboxNode(Monitor):
    """Passes images to an engine and publishes the results."""

    def __init__(self, engine: Engine, params: NodeParams) -> None:
        super().__init__(f"toolbox_{engine.name}", **params.monitor_settings())
        self._engine, self._period_began, self._reported = engine, time.monotonic(), engine.counts.copy()
        self._slowest = 0.0  # largest time from an image's arrival to its result in the period, seconds
        string = ros.message_type(STRING)
        self._results = self.create_publisher(string, params.results, RESULTS_QOS)
        kind = ros.message_type(COMPRESSED if params.compressed else IMAGE)
        for topic in params.images:
            name = qualified(topic, self.get_namespace())
            self.create_subscription(kind, topic, partial(self._submit, name, params.compressed), IMAGES_QOS)
        self._bus = Bus(self, BusParams.of_node(params, params.events_topic))
        self.create_timer(params.period, self._report_queue)

    def _submit(self, topic: str, compressed: bool, message: Any) -> None:
        header = message.header.stamp
        stamp = header.sec * 10**9 + header.nanosec
        self._engine.submit(Frame(f"{topic}@{stamp}", topic, stamp, _image(message, compressed), self._publish))

    def _publish(self, result: Result) -> None:
        if result.state == State.DONE and result.times:
            self._slowest = max(self._slowest, result.times.waited + result.times.worked)
        if result.state not in UNPUBLISHED_STATES:
            self._results.publish(ros.message(STRING, data=result.json_line()))

    def _report_queue(self) -> None:
        """Publish the state of the queue over the period, for autoscaling."""
        now, counts = time.monotonic(), self._engine.counts.copy()
        in_period = counts - self._reported
        waiting, oldest = self._engine.waiting()
        state = QueueState(
            queue=self._engine.name,
            seconds=now - self._period_began,
            arrived=in_period["received"],
            done=in_period[State.DONE],
            rejected=sum(in_period[state] for state in State if state != State.DONE),
            waiting=waiting,
            oldest=oldest,
            oldest_done=self._slowest,
            workers=int(self._engine.is_ready()),
        )
        self._period_began, self._reported, self._slowest = now, counts, 0.0
        self._bus.events.send("queue", state)

    def destroy_node(self) -> Any:
        """Leave the bus and destroy the node."""
        self._bus.close()
        return super().destroy_node()


def _image(message: Any, compressed: bool) -> Raw | bytes:
    if compressed:
        return bytes(message.data)
    return Raw.of(message)
