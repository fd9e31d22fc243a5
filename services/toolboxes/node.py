"""A toolbox as a node of ROS 2 that the bus watches: images on topics in, JSON on a topic out (D3.2, figure 16)."""

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

NEWEST = QoS(reliability="BEST_EFFORT", durability="VOLATILE", depth=2)
"""Of images: takes what anybody offers, and the newest of it."""
RESULTS = QoS(depth=100)
FAILED = (State.DROPPED, State.LATE)
"""Of which nothing is published: they are counted."""


class ToolboxNode(Monitor):
    """Hands images to an engine, and publishes what comes of them."""

    def __init__(self, engine: Engine, params: NodeParams) -> None:
        super().__init__(f"toolbox_{engine.name}", **params.monitored())
        self._engine, self._began, self._counted = engine, time.monotonic(), engine.counts.copy()
        self._slowest = 0.0  # seconds from an image's coming to its result, of those done lately
        string = ros.message_type(STRING)
        self._results = self.create_publisher(string, params.results, RESULTS)
        kind = ros.message_type(COMPRESSED if params.compressed else IMAGE)
        for topic in params.images:
            name = qualified(topic, self.get_namespace())
            self.create_subscription(kind, topic, partial(self._take, name, params.compressed), NEWEST)
        self._bus = Bus(
            self,
            BusParams(
                kafka_bootstrap_servers=params.kafka_bootstrap_servers,
                records_topic=params.publisher_topic,
                events_topic=params.events_topic,
            ),
        )
        self.create_timer(params.period, self._report_queue)

    def _take(self, topic: str, compressed: bool, message: Any) -> None:
        header = message.header.stamp
        stamp = header.sec * 10**9 + header.nanosec
        self._engine.submit(Frame(f"{topic}@{stamp}", topic, stamp, _image(message, compressed), self._publish))

    def _publish(self, result: Result) -> None:
        if result.state == State.DONE and result.times:
            self._slowest = max(self._slowest, result.times.waited + result.times.worked)
        if result.state not in FAILED:
            self._results.publish(ros.message(STRING, data=result.json_line()))

    def _report_queue(self) -> None:
        """What became of images over a period, for the bus: it may ask for more workers."""
        now, counts = time.monotonic(), self._engine.counts.copy()
        since = counts - self._counted
        waiting, oldest = self._engine.waiting()
        state = QueueState(
            queue=self._engine.name,
            seconds=now - self._began,
            arrived=since["received"],
            done=since[State.DONE],
            refused=sum(since[state] for state in State if state != State.DONE),
            waiting=waiting,
            oldest=oldest,
            oldest_done=self._slowest,
            workers=int(self._engine.is_ready()),
        )
        self._began, self._counted, self._slowest = now, counts, 0.0
        self._bus.events.send("queue", state)

    def destroy_node(self) -> Any:
        """Leave the bus, and end."""
        self._bus.close()
        return super().destroy_node()


def _image(message: Any, compressed: bool) -> Raw | bytes:
    if compressed:
        return bytes(message.data)
    return Raw(
        data=memoryview(message.data).cast("B"),
        height=message.height,
        width=message.width,
        encoding=message.encoding,
        step=message.step,
        big_endian=bool(message.is_bigendian),
    )
