"""A node whose publishers and subscriptions are watched, without change to its code (D3.2, code snippet 3).

    class Talker(Monitor):
        def __init__(self):
            super().__init__("talker", period=1.0, kafka_bootstrap_servers="localhost:9092")
            self.publisher = self.create_publisher(String, "chatter", 10)

Once a period, what went through it is told as a record (`services.monitoring.record`) on a ROS 2 topic, to Kafka, into
a file, on the console and to Prometheus, each as it was asked for. It runs on whatever transport there is.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import Any

from scan2sim.services import transport
from scan2sim.services.monitoring import compatibility, sinks
from scan2sim.services.monitoring.machine import Machine
from scan2sim.services.monitoring.meter import Meter
from scan2sim.services.monitoring.record import Record, TopicEndpoints, endpoint_info, flows_of, sums
from scan2sim.services.monitoring.watched import Watched
from scan2sim.services.records import new_ids
from scan2sim.services.transport import Arrival, QoS

log = logging.getLogger(__name__)

ros: Any = transport.load()
"""The transport: its file's functions."""
STRING = "std_msgs/msg/String"
"""What records are on a ROS 2 topic: JSON in a string, so that no message has to be built for them."""
OF_ROS = ("/rosout", "/parameter_events")
"""Topics that every node has of its own, and that aren't told."""
RECORDS = QoS(depth=100)


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
        self._told_on = super().create_publisher(ros.message_type(STRING), watched.publisher_topic, RECORDS)
        self._sinks = sinks.opened(watched, node_name)
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
        self._meter.received(arrival)

    def destroy_node(self) -> Any:
        """Tell the last record, and end."""
        if not self._ended.is_set():
            self._ended.set()
            self._telling.join()
            for sink in self._sinks:
                sink.close()
        return super().destroy_node()

    def _tell_periodically(self, period: float) -> None:
        began = due = time.monotonic()
        while not self._ended.is_set():
            due += period
            self._ended.wait(due - time.monotonic())
            now = time.monotonic()
            try:
                self._tell(now - began)
            except Exception:  # a node goes on, whatever becomes of its records
                log.exception("%s: a record could not be made", self.get_name())
            began, due = now, max(due, now - period)

    def _tell(self, seconds: float) -> None:
        record = self.record(seconds)
        self._told_on.publish(ros.message(STRING, data=record.json_line()))
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
            remarks=[text for topic, found in endpoints.items() for text in compatibility.remarks(topic, found)],
            dropped=sum(sink.dropped for sink in self._sinks),
            **Record.machine(self._machine.read()),
        )
