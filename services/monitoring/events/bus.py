"""Connection of a node to the bus: events and records over ROS 2 and, if configured, Kafka."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from scan2sim.services import default_outbox, kafka
from scan2sim.services.monitoring.events.schema import Event, Events
from scan2sim.services.monitoring.export.sinks import KafkaSink
from scan2sim.services.monitoring.node.monitor import RECORDS_QOS, STRING, ros
from scan2sim.services.monitoring.settings.bus import BusParams
from scan2sim.services.supervision import SupervisedThread

REACHED_INTERVAL_S = 1.0
"""Longest pause between two probes of an idle broker, if the caller waits for its signs."""
START_TIMEOUT_S = 5.0
"""Longest wait for the readers to start; they take less unless the machine is busy."""


class Bus:
    """Connects a node to the bus; an event that arrives over both ROS 2 and Kafka is processed once."""

    def __init__(
        self, node: Any, params: BusParams, *, records: bool = False, reached: Callable[[], None] | None = None,
        assigned: Callable[[str], None] = lambda _: None, seen: Mapping[str, int] | None = None,
    ) -> None:  # fmt: skip
        """Connect the node; it receives from `start` on.

        Args:
            node: a node of the transport.
            params: topics and Kafka servers.
            records: whether to receive monitoring records as well as events.
            reached: called at each sign that Kafka is there (`kafka.read`), at least every `REACHED_INTERVAL_S`, in a
                thread.
            assigned: called with a topic at each sign that Kafka is there and has assigned it, likewise.
            seen: state of the deduplicator of an earlier process, so that what Kafka delivers again is ignored.
        """
        self._reached, self._assigned = reached or (lambda: None), assigned
        self._probe_pause = REACHED_INTERVAL_S if reached else kafka.MAX_PROBE_PAUSE_S
        self._name = name = node.get_name()
        self.events = Events(name)
        self.events.deduplicator.restore(seen or {})
        self.events.outlets.append(RosOutlet(node, params.events_topic))
        topics = [params.events_topic, *([params.records_topic] if records else [])]
        for topic in topics:
            node.create_subscription(ros.message_type(STRING), topic, self._on_ros_message, RECORDS_QOS)
        self._closed = threading.Event()
        self._readers: list[tuple[SupervisedThread, threading.Event]] = []
        self._kafka: KafkaSink | None = None
        if servers := params.kafka_bootstrap_servers:
            outbox = default_outbox.open_outbox(f"{node.get_namespace()}/{name}", params.events_topic)
            cluster = kafka.Cluster.read(servers, params.kafka_config)
            self._kafka = KafkaSink(cluster, params.events_topic, outbox)
            self.events.outlets.append(self._kafka)
            for topic in topics:
                begun = threading.Event()
                job = partial(self._read_kafka, cluster, topic, begun)
                self._readers.append((SupervisedThread(job, f"{topic} for {name}"), begun))

    def start(self) -> None:
        """Start to receive by Kafka, after the calls of `events.on`: no event that reaches it from now on is missed.

        While no broker answers this takes some seconds, and such events are missed until one does.
        """
        for reader, _ in self._readers:
            reader.start()
        for _, begun in self._readers:
            begun.wait(START_TIMEOUT_S)

    def _on_ros_message(self, message: Any) -> None:
        self.events.receive(message.data)

    def _read_kafka(self, cluster: kafka.Cluster, topic: str, begun: threading.Event) -> None:
        # a group of its own for each topic: a member that joins interrupts all others of its group for seconds
        bodies = kafka.read(
            cluster, topic, group=f"scan2sim-{self._name}-{kafka.topic_name(topic)}", wait=0.5,
            reached=self._reached, connected=lambda is_connected: self._assigned(topic) if is_connected else None,
            max_probe_pause=self._probe_pause, rejected=self.events.rejections.add,
        )  # fmt: skip
        for body in bodies:
            begun.set()
            if self._closed.is_set():
                return
            if body is not None:
                kafka.process(body, self.events.receive, self.events.rejections.add)

    def dropped(self) -> Mapping[str, int]:
        """Number of events that were dropped because the outbox was full, by kind."""
        return self._kafka.dropped if self._kafka else {}

    def close(self) -> None:
        """Close all outlets and readers."""
        self._closed.set()
        for outlet in self.events.outlets:
            outlet.close()
        for reader, _ in self._readers:
            if reader.ident:
                reader.join(5.0)


class RosOutlet:
    """Outlet of events to a ROS 2 topic (`schema.Outlet`)."""

    def __init__(self, node: Any, topic: str) -> None:
        """Create the publisher of the topic on a node."""
        self._publisher = node.create_publisher(ros.message_type(STRING), topic, RECORDS_QOS)

    def send(self, event: Event) -> None:
        """Publish an event."""
        self._publisher.publish(ros.message(STRING, data=event.json_line()))

    def is_heard(self) -> bool:
        """Whether another node subscribes to the topic."""
        return bool(self._publisher.get_subscription_count())

    def is_delivered(self, seconds: float) -> bool:
        """Whether all subscribed nodes receive all events within some seconds."""
        return bool(self._publisher.wait_for_all_acked(seconds))

    def close(self) -> None:
        """Nothing to release: the node destroys its publishers."""
