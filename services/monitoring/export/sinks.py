"""Sinks of records: Kafka, a log file, the console, Prometheus. None of them blocks the node."""

from __future__ import annotations

import logging
import logging.handlers
from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

from scan2sim.pipeline.core import optional_deps
from scan2sim.services import default_outbox
from scan2sim.services.kafka import Cluster, TopicProducer
from scan2sim.services.monitoring.record import Record
from scan2sim.services.monitoring.settings.monitor import MonitorParams
from scan2sim.services.outbox import Outbox, Sender

MAX_LOG_BYTES, ROTATED_LOG_FILES = 16 * 2**20, 4
"""Size at which a log file is rotated, and number of rotated files that are kept."""


class Message(Protocol):
    """Message for Kafka: a record or an event."""

    @property
    def id(self) -> str:
        """Globally unique id."""

    @property
    def category(self) -> str:
        """Category in an outbox (`outbox.Outbox`)."""

    def json_line(self) -> str:
        """Serialize as one line of JSON."""


class Sink(Protocol):
    """Destination of records."""

    @property
    def dropped(self) -> Mapping[str, int]:
        """Number of messages that were dropped because the outbox was full, by category."""

    def send(self, record: Record, /) -> None:
        """Accept a record without blocking."""

    def close(self) -> None:
        """Release all resources."""


def open_sinks(params: MonitorParams, node: str) -> list[Sink]:
    """Open all sinks that are configured for a node, given by its full name."""
    sinks: list[Sink] = []
    if params.kafka_bootstrap_servers:
        outbox = Outbox(params.outbox) if params.outbox else default_outbox.open_outbox(node, params.publisher_topic)
        cluster = Cluster.read(params.kafka_bootstrap_servers, params.kafka_config)
        sinks.append(KafkaSink(cluster, params.publisher_topic, outbox))
    if params.log_file:
        sinks.append(JsonLinesSink.file(params.log_file))
    if params.console:
        sinks.append(JsonLinesSink.console())
    if params.prometheus_port is not None:
        sinks.append(PrometheusSink(params.prometheus_port))
    return sinks


class KafkaSink:
    """Sends messages to a Kafka topic through an outbox on disk: unsent messages are retried, in order."""

    def __init__(self, cluster: Cluster, topic: str, outbox: Outbox) -> None:
        self._outbox = outbox
        self._sender = Sender(self._outbox, TopicProducer(cluster, topic).send)

    @property
    def dropped(self) -> Mapping[str, int]:
        """Number of messages that were dropped because the outbox was full, by category."""
        return self._outbox.dropped

    def send(self, message: Message) -> None:
        """Append a message to the outbox and wake its sender."""
        self._outbox.append(message.id, message.json_line().encode(), message.category)
        self._sender.wake()

    def close(self) -> None:
        """Send pending messages within a few seconds and close the outbox."""
        self._sender.close()
        self._outbox.close()


class JsonLinesSink:
    """Writes each record as a line of JSON to a rotating log file or to the console."""

    dropped: Mapping[str, int] = {}

    def __init__(self, handler: logging.Handler) -> None:
        self._handler = handler

    @classmethod
    def file(cls, path: Path) -> JsonLinesSink:
        """Sink to a rotating log file."""
        path.parent.mkdir(parents=True, exist_ok=True)
        return cls(logging.handlers.RotatingFileHandler(path, maxBytes=MAX_LOG_BYTES, backupCount=ROTATED_LOG_FILES))

    @classmethod
    def console(cls) -> JsonLinesSink:
        """Sink to standard error."""
        return cls(logging.StreamHandler())

    def send(self, record: Record) -> None:
        """Write a record."""
        self._handler.emit(logging.makeLogRecord({"msg": record.json_line()}))

    def close(self) -> None:
        """Close the file."""
        self._handler.close()


class PrometheusSink:
    """Exports the latest record at http://127.0.0.1:PORT/metrics; without a token, hence on loopback only."""

    dropped: Mapping[str, int] = {}

    def __init__(self, port: int) -> None:
        optional_deps.require("Prometheus", "prometheus_client")
        from prometheus_client import CollectorRegistry, Counter, Gauge, start_http_server

        registry = CollectorRegistry()
        flow = ("node", "topic", "direction")
        self._flows = {
            key: Gauge(f"scan2sim_{name}", help_, flow, registry=registry)
            for key, name, help_ in (
                ("bandwidth", "bandwidth_bytes_per_second", "Bytes per second over the last period"),
                ("messages", "messages_in_period", "Messages over the last period"),
                ("size", "message_size_bytes", "Mean message size over the last period"),
                ("lost", "lost_messages_in_period", "Messages published but not received in the last period"),
                ("latency", "latency_nanoseconds", "Mean time from publishing to receiving"),
                ("latency_p95", "latency_p95_nanoseconds", "95th percentile of the latency"),
            )
        }
        self._totals = {
            key: Counter(f"scan2sim_{name}", help_, flow, registry=registry)
            for key, name, help_ in (
                ("messages", "messages", "Messages since the start"),
                ("bytes", "bytes", "Bytes since the start"),
                ("lost", "lost_messages", "Messages published but not received since the start"),
            )
        }
        self._cpu = Gauge("scan2sim_cpu_percent", "CPU load of the machine", ("node",), registry=registry)
        self._server, self._thread = start_http_server(port, "127.0.0.1", registry)

    @property
    def port(self) -> int:
        """Port on which it listens."""
        return int(self._server.server_port)

    def send(self, record: Record) -> None:
        """Set the gauges to the values of a record, and add them to the totals."""
        node = record.node_namespace.rstrip("/") + "/" + record.node_name
        for flow in record.flows:
            for key, gauge in self._flows.items():
                value = getattr(flow, key)
                if value is not None:
                    gauge.labels(node, flow.topic, flow.direction).set(value)
            added = {"messages": flow.messages, "bytes": flow.bandwidth * record.period, "lost": flow.lost or 0}
            for key, counter in self._totals.items():
                counter.labels(node, flow.topic, flow.direction).inc(max(0.0, added[key]))
        self._cpu.labels(node).set(record.cpu_percent)

    def close(self) -> None:
        """Stop the HTTP server."""
        self._server.shutdown()
        self._server.server_close()
