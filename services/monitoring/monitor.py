"""A node whose publishers and subscriptions are watched, without change to its code (D3.2, code snippet 3).

    class Talker(Monitor):
        def __init__(self):
            super().__init__("talker", period=1.0, kafka_bootstrap_servers="localhost:9092")
            self.publisher = self.create_publisher(String, "chatter", 10)

Once a period, what went through it is told as a record (`services.monitoring.record`) on a ROS 2 topic, to Kafka, into
a file, on the console and to Prometheus, each as it was asked for. It runs on whatever transport there is.
"""

from __future__ import annotations

import contextlib
import json
import logging
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

from scan2sim.services import transport
from scan2sim.services.monitoring import clock, compatibility, sinks
from scan2sim.services.monitoring.machine import Machine
from scan2sim.services.monitoring.meter import Meter
from scan2sim.services.monitoring.record import Record, TopicEndpoints, endpoint_info, flows_of, sums
from scan2sim.services.monitoring.watched import Watched
from scan2sim.services.records import new_ids
from scan2sim.services.transport import Arrival, Endpoint, QoS

log = logging.getLogger(__name__)

ros: Any = transport.load()
"""The transport: its file's functions."""
STRING = "std_msgs/msg/String"
"""What records are on a ROS 2 topic: JSON in a string, so that no message has to be built for them."""
OF_ROS = ("/rosout", "/parameter_events")
"""Topics that every node has of its own, and that aren't told."""
RECORDS = QoS(depth=100)
CLOCK = QoS(reliability="BEST_EFFORT", depth=100)
"""What comes late is of no use."""


SPUN = 0.2
"""Seconds after which a node that is to end notices it, at most."""


class _Companion(ros.Node):  # type: ignore[misc]
    """A hidden node beside a watched one, in a thread of its own: it tells records, and exchanges times with others.

    So records go out though the watched node is busy, and watching doesn't slow its waiting down.
    """

    def __init__(self, node_name: str, namespace: str, topic: str) -> None:
        super().__init__(f"_{node_name}_monitor", namespace=namespace, hidden=True)
        string = ros.message_type(STRING)
        self._records = self.create_publisher(string, topic, RECORDS)
        self.clock = clock.Clock()
        self._arrival: Arrival | None = None
        self._times = self.create_publisher(string, clock.TOPIC, CLOCK)
        self.create_subscription(string, clock.TOPIC, self._take_time, CLOCK)

    def tell(self, record: Record) -> None:
        """Send a record."""
        self._exchange(self.clock.hello())
        self._records.publish(ros.message(STRING, data=record.json_line()))

    def offset(self, publisher: bytes | None) -> tuple[int, int] | None:
        """As `Clock.offset`; who isn't known well is asked for the time."""
        if publisher is None:
            return None
        self._exchange(self.clock.ping(publisher))
        return self.clock.offset(publisher)

    def received(self, arrival: Arrival) -> None:
        """Keep what is known of the message that is handed on next."""
        self._arrival = arrival

    def _take_time(self, message: Any) -> None:
        arrival = self._arrival
        if arrival and arrival.publisher:
            with contextlib.suppress(ValueError, TypeError):  # somebody else's message
                self._exchange(self.clock.heard(json.loads(message.data), arrival.publisher, arrival.received))

    def _exchange(self, told: dict[str, Any] | None) -> None:
        if told:
            self._times.publish(ros.message(STRING, data=json.dumps(told)))


class Monitor(ros.Node):  # type: ignore[misc]
    """A node that is watched."""

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
        self._meter, self._machine = Meter(watched.window_size), Machine()
        self._types: dict[str, str] = {}
        self._next_id, self._ended = new_ids(), threading.Event()
        super().__init__(node_name, namespace=namespace, **named)
        self._companion = _Companion(node_name, namespace, watched.publisher_topic)
        self._sinks = sinks.opened(watched, f"{self.get_namespace()}/{node_name}")
        self._telling = threading.Thread(
            target=self._tell_periodically, args=(watched.period,), name=f"{node_name} monitor", daemon=True
        )
        self._telling.start()

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
        self._meter.received(arrival, self._companion.offset(arrival.publisher))

    def destroy_node(self) -> Any:
        """Tell the last record, and end."""
        if not self._ended.is_set():
            self._ended.set()
            self._telling.join()
            for sink in self._sinks:
                sink.close()
            self._companion.destroy_node()
        return super().destroy_node()

    def _tell_periodically(self, period: float) -> None:
        began, due = time.monotonic(), time.monotonic() + period
        while not self._ended.is_set():
            ros.spin_once(self._companion, min(SPUN, max(0.0, due - time.monotonic())))
            now = time.monotonic()
            if now >= due or self._ended.is_set():
                try:
                    self._tell(now - began)
                except Exception:  # a node goes on, whatever becomes of its records
                    log.exception("%s: a record could not be made", self.get_name())
                began, due = now, max(due + period, now)

    def _tell(self, seconds: float) -> None:
        record = self.record(seconds)
        self._companion.tell(record)
        for sink in self._sinks:
            sink.send(record)

    def record(self, seconds: float) -> Record:
        """What went through the node in the last so many seconds; counting begins anew."""
        reading = self._meter.read()
        types = dict(self._types)
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
            flows=flows_of(reading, types, seconds),
            endpoints=[
                TopicEndpoints(
                    topic_name=topic,
                    publishers=[endpoint_info(one) for one in found if one.kind == "PUBLISHER"],
                    subscriptions=[endpoint_info(one) for one in found if one.kind == "SUBSCRIPTION"],
                )
                for topic, found in endpoints.items()
            ],
            remarks=self._remarks(endpoints),
            clock_synchronised=clock.synchronised(),
            dropped=sum(sum(sink.dropped.values()) for sink in self._sinks),
            **Record.machine(self._machine.read()),
        )

    def _remarks(self, endpoints: Mapping[str, tuple[Endpoint, ...]]) -> list[str]:
        jumped = self._companion.clock.jump()
        told = (
            [f"this machine's clock was set by {jumped:+.3f} s; latencies of this period are wrong"] if jumped else []
        )
        return told + [text for topic, found in endpoints.items() for text in compatibility.remarks(topic, found)]
