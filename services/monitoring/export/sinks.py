"""Where records go: Kafka, a file, the console, Prometheus. None of them keeps the node waiting."""

from __future__ import annotations

import logging
import logging.handlers
from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

from scan2sim.pipeline.core import optional_deps
from scan2sim.services import default_outbox
from scan2sim.services.kafka import Topic
from scan2sim.services.monitoring.node.record import Record
from scan2sim.services.monitoring.settings.monitor import Watched
from scan2sim.services.outbox import Sender, Spool

LOG_BYTES, LOG_FILES = 16 * 2**20, 4
"""Size of a log, and how many older ones are kept beside it."""


class Message(Protocol):
    """What goes to Kafka: a record, an event."""

    @property
    def id(self) -> str:
        """Unlike any other's."""

    @property
    def share(self) -> str:
        """What it counts for, where room is short."""

    def json_line(self) -> str:
        """As one line of JSON."""


class Sink(Protocol):
    """Takes records."""

    @property
    def dropped(self) -> Mapping[str, int]:
        """Messages that were given up, as there was no room for them, by their share."""

    def send(self, record: Record, /) -> None:
        """Take one, at once."""

    def close(self) -> None:
        """Take no more."""


def opened(watched: Watched, node: str) -> list[Sink]:
    """All that are set, of a node by its full name."""
    found: list[Sink] = []
    if watched.kafka_bootstrap_servers:
        spool = Spool(watched.spool) if watched.spool else default_outbox.opened(node, watched.publisher_topic)
        found.append(Kafka(watched.kafka_bootstrap_servers, watched.publisher_topic, spool))
    if watched.log_file:
        found.append(Lines.file(watched.log_file))
    if watched.console:
        found.append(Lines.console())
    if watched.prometheus_port is not None:
        found.append(Prometheus(watched.prometheus_port))
    return found


class Kafka:
    """A topic of Kafka, by way of the disk: what can't be sent now is sent later, in order."""

    def __init__(self, servers: str, topic: str, spool: Spool) -> None:
        self._spool = spool
        self._sender = Sender(self._spool, Topic(servers, topic).send)

    @property
    def dropped(self) -> Mapping[str, int]:
        """Messages that were given up, as there was no room for them on disk, by their share."""
        return self._spool.dropped

    def send(self, message: Message) -> None:
        """Keep it, to be sent."""
        self._spool.append(message.id, message.json_line().encode(), message.share)
        self._sender.wake()

    def close(self) -> None:
        """Send what can be sent soon."""
        self._sender.close()
        self._spool.close()


class Lines:
    """A line of JSON a record: in a file that is changed when it is full, or on the console."""

    dropped: Mapping[str, int] = {}

    def __init__(self, handler: logging.Handler) -> None:
        self._handler = handler

    @classmethod
    def file(cls, path: Path) -> Lines:
        """Into a file, with the last ones beside it."""
        path.parent.mkdir(parents=True, exist_ok=True)
        return cls(logging.handlers.RotatingFileHandler(path, maxBytes=LOG_BYTES, backupCount=LOG_FILES))

    @classmethod
    def console(cls) -> Lines:
        """On standard error."""
        return cls(logging.StreamHandler())

    def send(self, record: Record) -> None:
        """Write it."""
        self._handler.emit(logging.makeLogRecord({"msg": record.json_line()}))

    def close(self) -> None:
        """Close the file."""
        self._handler.close()


class Prometheus:
    """The last record's figures at http://127.0.0.1:PORT/metrics; it needs no token, so no other machine reaches it."""

    dropped: Mapping[str, int] = {}

    def __init__(self, port: int) -> None:
        optional_deps.need("Prometheus", "prometheus_client")
        from prometheus_client import CollectorRegistry, Gauge, start_http_server

        registry = CollectorRegistry()
        flow = ("node", "topic", "direction")
        self._flows = {
            key: Gauge(f"scan2sim_{name}", help_, flow, registry=registry)
            for key, name, help_ in (
                ("bandwidth", "bandwidth_bytes_per_second", "Bytes a second over the last period"),
                ("messages", "messages", "Messages over the last period"),
                ("size", "message_size_bytes", "Mean size of messages"),
                ("lost", "lost_messages", "Messages that their publisher sent and that didn't come"),
                ("latency", "latency_nanoseconds", "Mean time from sending to receiving"),
                ("latency_p95", "latency_p95_nanoseconds", "What 95 of 100 latencies don't exceed"),
            )
        }
        self._cpu = Gauge("scan2sim_cpu_percent", "Load of the machine", ("node",), registry=registry)
        self._server, self._thread = start_http_server(port, "127.0.0.1", registry)

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self._server.server_port)

    def send(self, record: Record) -> None:
        """Show its figures."""
        node = record.node_namespace.rstrip("/") + "/" + record.node_name
        for flow in record.flows:
            for key, gauge in self._flows.items():
                value = getattr(flow, key)
                if value is not None:
                    gauge.labels(node, flow.topic, flow.direction).set(value)
        self._cpu.labels(node).set(record.cpu_percent)

    def close(self) -> None:
        """Listen no more."""
        self._server.shutdown()
        self._server.server_close()
