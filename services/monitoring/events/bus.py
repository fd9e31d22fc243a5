"""A node's place on the bus: events and records over ROS 2 and, where there is one, Kafka."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

from scan2sim.services import default_outbox, kafka
from scan2sim.services.monitoring.events.schema import Event, Events
from scan2sim.services.monitoring.export.sinks import Kafka
from scan2sim.services.monitoring.node.monitor import RECORDS, STRING, ros
from scan2sim.services.monitoring.settings.bus import BusParams


class Bus:
    """Joins a node to the bus; what comes over both ways is taken once."""

    def __init__(self, node: Any, params: BusParams, *, records: bool = False) -> None:
        """`records`: whether it wants monitors' records as well as events."""
        name = node.get_name()
        self.events = Events(name)
        self.events.outlets.append(Topic(node, params.events_topic))
        topics = [params.events_topic, *([params.records_topic] if records else [])]
        for topic in topics:
            node.create_subscription(ros.message_type(STRING), topic, self._take, RECORDS)
        self._closed = threading.Event()
        self._readers: list[threading.Thread] = []
        self._kafka: Kafka | None = None
        if servers := params.kafka_bootstrap_servers:
            spool = default_outbox.opened(f"{node.get_namespace()}/{name}", params.events_topic)
            self._kafka = Kafka(servers, params.events_topic, spool)
            self.events.outlets.append(self._kafka)
            for topic in topics:
                reader = threading.Thread(target=self._read, args=(servers, topic, f"scan2sim-{name}"), daemon=True)
                reader.start()
                self._readers.append(reader)

    def _take(self, message: Any) -> None:
        self.events.take(message.data)

    def _read(self, servers: str, topic: str, group: str) -> None:
        for body in kafka.read(servers, topic, group=group, wait=0.5):
            if self._closed.is_set():
                return
            if body is not None:
                self.events.take(body)

    def dropped(self) -> Mapping[str, int]:
        """Events that were given up, as there was no room for them on disk, by kind."""
        return self._kafka.dropped if self._kafka else {}

    def close(self) -> None:
        """Leave the bus."""
        self._closed.set()
        for outlet in self.events.outlets:
            outlet.close()
        for reader in self._readers:
            reader.join(5.0)


class Topic:
    """Events on a topic of ROS 2: an `events.Outlet`."""

    def __init__(self, node: Any, topic: str) -> None:
        """By a publisher of the node's."""
        self._publisher = node.create_publisher(ros.message_type(STRING), topic, RECORDS)

    def send(self, event: Event) -> None:
        """Publish one."""
        self._publisher.publish(ros.message(STRING, data=event.json_line()))

    def close(self) -> None:
        """The node closes its publishers."""
