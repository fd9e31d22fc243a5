"""A node whose publishers and subscriptions are watched, without change to its code (D3.2, code snippet 3).

    class Talker(Monitor):
        def __init__(self):
            super().__init__("talker", period=1.0, kafka_bootstrap_servers="localhost:9092")
            self.publisher = self.create_publisher(String, "chatter", 10)

Once a period, what went through it is published as a record (`services.monitoring.node.record`) on a ROS 2 topic, to
Kafka, into a file, on the console and to Prometheus, each as it was asked for. It runs on whatever transport there is.
"""

from __future__ import annotations

import contextlib
import json
import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

from scan2sim.services import transport
from scan2sim.services.monitoring.export import sinks
from scan2sim.services.monitoring.node import clock_sync, qos_check
from scan2sim.services.monitoring.node.host import Machine
from scan2sim.services.monitoring.node.meter import Meter
from scan2sim.services.monitoring.node.record import Record, TopicEndpoints, TopicFlow, endpoint_info, flows_of, sums
from scan2sim.services.monitoring.settings.monitor import Watched
from scan2sim.services.outbox import new_ids
from scan2sim.services.transport import Arrival, QoS

log = logging.getLogger(__name__)

ros: Any = transport.load()
"""The transport: its file's functions."""
STRING = "std_msgs/msg/String"
"""What records are on a ROS 2 topic: JSON in a string, so that no message has to be built for them."""
OF_ROS = ("/rosout", "/parameter_events")
"""Topics that every node has of its own, and that aren't watched."""
RECORDS = QoS(depth=100)
CLOCK = QoS(reliability="BEST_EFFORT", depth=100)
"""What comes late is of no use."""


SPUN = 0.2
"""Seconds after which a node that is to end notices it, at most."""


class _Companion(ros.Node):  # type: ignore[misc]
    """A hidden node beside a watched one, in a thread of its own: it publishes records, and asks others for the time.

    So records go out though the watched node is busy, and watching doesn't slow its waiting down.
    """

    def __init__(self, node_name: str, namespace: str, topic: str) -> None:
        super().__init__(f"_{node_name}_monitor", namespace=namespace, hidden=True)
        string = ros.message_type(STRING)
        self._records = self.create_publisher(string, topic, RECORDS)
        self.clock = clock_sync.Clock()
        self._arrival: Arrival | None = None
        self._times = self.create_publisher(string, clock_sync.TOPIC, CLOCK)
        self.create_subscription(string, clock_sync.TOPIC, self._take_time, CLOCK)

    def publish(self, record: Record) -> None:
        """Send a record."""
        self._exchange(self.clock.hello())
        self._records.publish(ros.message(STRING, data=record.json_line()))

    def ask(self, publishers: Iterable[bytes]) -> None:
        """Ask the processes of publishers for the time, as far as their clocks aren't known well."""
        for publisher in publishers:
            self._exchange(self.clock.ping(publisher))

    def received(self, arrival: Arrival) -> None:
        """Keep what is known of the message that is handed on next."""
        self._arrival = arrival

    def _take_time(self, message: Any) -> None:
        arrival = self._arrival
        if arrival and arrival.publisher:
            with contextlib.suppress(ValueError, TypeError, RecursionError):  # somebody else's message
                self._exchange(self.clock.heard(json.loads(message.data), arrival.publisher, arrival.received))

    def _exchange(self, times: dict[str, Any] | None) -> None:
        if times:
            self._times.publish(ros.message(STRING, data=json.dumps(times)))


class Monitor(ros.Node):  # type: ignore[misc]
    """A node that is watched.

    Attributes:
        drops: say what was given up by others than its own sinks, by kind; counted in its records.
    """

    def __init__(self, node_name: str, *, namespace: str = "/", **named: Any) -> None:
        """Watch from now on.

        Args:
            node_name: of the node.
            namespace: of the node.
            named: fields of `Watched`; others are the transport's own.

        Raises:
            SettingError: a field is out of its range.
        """
        watched = Watched.of("", {name: named.pop(name) for name in list(named) if name in Watched.model_fields})
        self._meter, self._machine, self._limits = Meter(watched.window_size), Machine(), watched.limit
        self.drops: list[Callable[[], Mapping[str, int]]] = []
        self._types: dict[str, str] = {}
        self._next_id, self._ended = new_ids(), threading.Event()
        super().__init__(node_name, namespace=namespace, **named)
        self._companion = _Companion(node_name, namespace, watched.publisher_topic)
        self._sinks = sinks.opened(watched, f"{self.get_namespace()}/{node_name}")
        self._reporting = threading.Thread(
            target=self._report_periodically, args=(watched.period,), name=f"{node_name} monitor", daemon=True
        )
        self._reporting.start()

    def create_publisher(self, msg_type: Any, topic: str, qos_profile: Any, **others: Any) -> Any:
        """As rclpy's."""
        made = super().create_publisher(msg_type, topic, qos_profile, **others)
        if made.topic_name not in OF_ROS:
            self._types[made.topic_name] = ros.type_name(msg_type)
        return made

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[..., None], qos_profile: Any, **others: Any
    ) -> Any:
        """As rclpy's."""
        made = super().create_subscription(msg_type, topic, callback, qos_profile, **others)
        self._types[made.topic_name] = ros.type_name(msg_type)
        return made

    def published(self, topic: str, size: int) -> None:
        """Count a message."""
        if topic in self._types:
            self._meter.published(topic, size)

    def received(self, arrival: Arrival) -> None:
        """Count a message."""
        self._meter.received(arrival)

    def unreadable(self, topic: str) -> None:
        """Count a message that isn't of its topic's type."""
        self._meter.unreadable(topic)

    def destroy_node(self) -> Any:
        """Publish the last record, and end."""
        if not self._ended.is_set():
            self._ended.set()
            self._reporting.join()
            for sink in self._sinks:
                sink.close()
            self._companion.destroy_node()
        return super().destroy_node()

    def _report_periodically(self, period: float) -> None:
        began, due = time.monotonic(), time.monotonic() + period
        while not self._ended.is_set():
            ros.spin_once(self._companion, min(SPUN, max(0.0, due - time.monotonic())))
            self._companion.ask(self._meter.publishers())
            now = time.monotonic()
            if now >= due or self._ended.is_set():
                try:
                    self._report(now - began)
                except Exception:  # a node goes on, whatever becomes of its records
                    log.exception("%s: a record could not be made", self.get_name())
                began, due = now, max(due + period, now)

    def _report(self, seconds: float) -> None:
        record = self.record(seconds)
        self._companion.publish(record)
        for sink in self._sinks:
            sink.send(record)

    def record(self, seconds: float) -> Record:
        """What went through the node in the last so many seconds; counting begins anew."""
        jumped = self._companion.clock.jump()
        reading = self._meter.read(self._companion.clock.offset)
        types = dict(self._types)
        flows = flows_of(reading, types, seconds)
        dropped = sum((Counter(one) for one in self._dropped()), Counter[str]())
        endpoints = {topic: self.endpoints(topic) for topic in types}
        record_id = self._next_id()
        return Record(
            id=record_id,
            time=time.time(),
            period=seconds,
            node_name=self.get_name(),
            node_namespace=self.get_namespace(),
            node_id=record_id.partition(":")[0],
            **sums(reading, seconds),
            publishers=sum(one.kind == "PUBLISHER" for found in endpoints.values() for one in found),
            subscribers=sum(one.kind == "SUBSCRIPTION" for found in endpoints.values() for one in found),
            topics=sorted(types),
            flows=flows,
            endpoints=[
                TopicEndpoints(
                    topic_name=topic,
                    publishers=[endpoint_info(one) for one in found if one.kind == "PUBLISHER"],
                    subscriptions=[endpoint_info(one) for one in found if one.kind == "SUBSCRIPTION"],
                )
                for topic, found in endpoints.items()
            ],
            remarks=[
                *_jump_remarks(jumped),
                *_unreadable_remarks(flows),
                *self._limits.exceeded(flows),
                *(text for topic, found in endpoints.items() for text in qos_check.remarks(topic, found)),
            ],
            clock_synchronised=clock_sync.synchronised(),
            dropped=dropped.total(),
            dropped_by=dict(dropped),
            **Record.machine(self._machine.read()),
        )

    def _dropped(self) -> Iterator[Mapping[str, int]]:
        yield from (sink.dropped for sink in self._sinks)
        yield from (drops() for drops in self.drops)


def _jump_remarks(jumped: float) -> list[str]:
    return [f"this machine's clock was set by {jumped:+.3f} s; latencies of this period are wrong"] if jumped else []


def _unreadable_remarks(flows: Iterable[TopicFlow]) -> list[str]:
    return [f"{one.topic}: {one.unreadable} messages are no {one.type}" for one in flows if one.unreadable]
