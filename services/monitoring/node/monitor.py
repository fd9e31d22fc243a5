"""Instrumented ROS 2 node: its publishers and subscriptions are monitored without changes to its code.

    class Talker(Monitor):
        def __init__(self):
            super().__init__("talker", period=1.0, kafka_bootstrap_servers="localhost:9092")  # D3.2, code snippet 3
            self.publisher = self.create_publisher(ros.message_type(STRING), "chatter", 10)

Once per period its traffic is published as a record (`services.monitoring.record`) on a ROS 2 topic and, if
configured, to Kafka, a file, the console and Prometheus. It runs on either transport (`services.transport`).
"""

from __future__ import annotations

import contextlib
import json
import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from typing import Any

from scan2sim.services import transport
from scan2sim.services.monitoring.export import sinks
from scan2sim.services.monitoring.meter import Meter
from scan2sim.services.monitoring.node import clock_sync, qos_check
from scan2sim.services.monitoring.node.host import HostMetrics
from scan2sim.services.monitoring.record import (
    Record,
    TopicEndpoints,
    TopicFlow,
    endpoint_info,
    topic_flows,
    totals,
)
from scan2sim.services.monitoring.settings.monitor import MonitorParams
from scan2sim.services.outbox import new_ids
from scan2sim.services.supervision import SupervisedThread
from scan2sim.services.transport import Arrival, QoS

log = logging.getLogger(__name__)

ros: Any = transport.load()
"""The transport module that is used (a `services.transport.Transport`)."""
STRING = "std_msgs/msg/String"
"""Message type of records on a ROS 2 topic: JSON in a string, so that no custom message has to be compiled."""
INTERNAL_TOPICS = ("/rosout", "/parameter_events")
"""Topics that every node has; they aren't monitored."""
RECORDS_QOS = QoS(depth=100)
CLOCK_QOS = QoS(reliability="BEST_EFFORT", depth=100)
"""Best effort: a retransmitted timestamp is useless."""
SPIN_TIMEOUT_S = 0.2
"""Upper bound of the time until the reporting thread notices that the node ends."""


class _Companion(ros.Node):  # type: ignore[misc]
    """Hidden node beside an instrumented one, in its own thread: publishes records and exchanges clock offsets.

    Records are published even if the instrumented node is busy, and monitoring doesn't slow its executor down.
    """

    def __init__(self, node_name: str, namespace: str, topic: str) -> None:
        super().__init__(f"_{node_name}_monitor", namespace=namespace, hidden=True)
        string = ros.message_type(STRING)
        self._records = self.create_publisher(string, topic, RECORDS_QOS)
        self.clock = clock_sync.ClockSync()
        self._arrival: Arrival | None = None
        self._clock_messages = self.create_publisher(string, clock_sync.TOPIC, CLOCK_QOS)
        self.create_subscription(string, clock_sync.TOPIC, self._on_clock_message, CLOCK_QOS)

    def publish(self, record: Record) -> None:
        """Publish a record."""
        self._send_clock_message(self.clock.hello())
        self._records.publish(ros.message(STRING, data=record.json_line()))

    def ping(self, publishers: Iterable[bytes]) -> None:
        """Ping the processes of publishers whose clock offsets are due for an update."""
        for publisher in publishers:
            self._send_clock_message(self.clock.ping(publisher))

    def received(self, arrival: Arrival) -> None:
        """Store the metadata of the message that is passed to the callback next."""
        self._arrival = arrival

    def _on_clock_message(self, message: Any) -> None:
        arrival = self._arrival
        if arrival and arrival.publisher:
            with contextlib.suppress(ValueError, TypeError, RecursionError):  # malformed, or another program's message
                reply = self.clock.handle(json.loads(message.data), arrival.publisher, arrival.received)
                self._send_clock_message(reply)

    def _send_clock_message(self, message: dict[str, Any] | None) -> None:
        if message:
            self._clock_messages.publish(ros.message(STRING, data=json.dumps(message)))


class Monitor(ros.Node):  # type: ignore[misc]
    """Instrumented node: base class that counts everything its publishers and subscriptions transfer.

    Attributes:
        drops: functions that return the number of dropped messages by kind; added to the drops of its own sinks.
    """

    def __init__(self, node_name: str, *, namespace: str = "/", **settings: Any) -> None:
        """Create the node and start monitoring.

        Args:
            node_name: name of the node.
            namespace: namespace of the node.
            settings: fields of `MonitorParams`; any others are passed to the transport's node.

        Raises:
            SettingError: a field is out of range.
        """
        fields = {name: settings.pop(name) for name in list(settings) if name in MonitorParams.model_fields}
        params = MonitorParams.of("", fields)
        self._meter, self._host, self._limits = Meter(params.window_size), HostMetrics(), params.limit
        self.drops: list[Callable[[], Mapping[str, int]]] = []
        self._types: dict[str, str] = {}
        self._next_id, self._ended = new_ids(), threading.Event()
        super().__init__(node_name, namespace=namespace, **settings)
        self._companion = _Companion(node_name, namespace, params.publisher_topic)
        self._sinks = sinks.open_sinks(params, f"{self.get_namespace()}/{node_name}")
        self._reporting = SupervisedThread(partial(self._report_periodically, params.period), f"{node_name} monitor")
        self._reporting.start()

    def create_publisher(self, msg_type: Any, topic: str, qos_profile: Any, **others: Any) -> Any:
        """Like rclpy's `create_publisher`; the publisher's topic is monitored."""
        publisher = super().create_publisher(msg_type, topic, qos_profile, **others)
        if publisher.topic_name not in INTERNAL_TOPICS:
            self._types[publisher.topic_name] = ros.type_name(msg_type)
        return publisher

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[..., None], qos_profile: Any, **others: Any
    ) -> Any:
        """Like rclpy's `create_subscription`; the subscription's topic is monitored."""
        subscription = super().create_subscription(msg_type, topic, callback, qos_profile, **others)
        self._types[subscription.topic_name] = ros.type_name(msg_type)
        return subscription

    def published(self, topic: str, size: int) -> None:
        """Count a published message."""
        if topic in self._types:
            self._meter.published(topic, size)

    def received(self, arrival: Arrival) -> None:
        """Count a received message."""
        self._meter.received(arrival)

    def unreadable(self, topic: str) -> None:
        """Count a received message that could not be deserialized as its topic's type."""
        self._meter.unreadable(topic)

    def destroy_node(self) -> Any:
        """Publish the last record and destroy the node."""
        if not self._ended.is_set():
            self._ended.set()
            self._reporting.join()
            for sink in self._sinks:
                sink.close()
            self._companion.destroy_node()
        return super().destroy_node()

    def _report_periodically(self, period: float) -> None:
        period_began, due = time.monotonic(), time.monotonic() + period
        while not self._ended.is_set():
            ros.spin_once(self._companion, min(SPIN_TIMEOUT_S, max(0.0, due - time.monotonic())))
            self._companion.ping(self._meter.publishers())
            now = time.monotonic()
            if now >= due or self._ended.is_set():
                try:
                    self._report(now - period_began)
                except Exception:  # a failure to report must not stop the node
                    log.exception("%s: the record of this period could not be published", self.get_name())
                period_began, due = now, max(due + period, now)

    def _report(self, seconds: float) -> None:
        record = self.record(seconds)
        self._companion.publish(record)
        for sink in self._sinks:
            sink.send(record)

    def record(self, seconds: float) -> Record:
        """Record of the node's traffic in the last `seconds`; the counters restart at zero."""
        clock_jump_s = self._companion.clock.detect_jump()
        reading = self._meter.read(self._companion.clock.offset)
        types = dict(self._types)
        flows = topic_flows(reading, types, seconds)
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
            **totals(reading, seconds),
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
            warnings=[
                *_clock_warnings(clock_jump_s),
                *_unreadable_warnings(flows),
                *self._limits.exceeded(flows),
                *(text for topic, found in endpoints.items() for text in qos_check.qos_warnings(topic, found)),
            ],
            clock_synchronised=clock_sync.synchronised(),
            dropped=dropped.total(),
            dropped_by=dict(dropped),
            **Record.host_fields(self._host.read()),
        )

    def _dropped(self) -> Iterator[Mapping[str, int]]:
        yield from (sink.dropped for sink in self._sinks)
        yield from (drops() for drops in self.drops)


def _clock_warnings(jump_s: float) -> list[str]:
    return [f"this machine's clock was set by {jump_s:+.3f} s; latencies of this period are wrong"] if jump_s else []


def _unreadable_warnings(flows: Iterable[TopicFlow]) -> list[str]:
    return [f"{one.topic}: {one.unreadable} messages are not valid {one.type}" for one in flows if one.unreadable]
