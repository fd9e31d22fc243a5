"""Kafka producer and consumer of records, with retries and deduplication by record id."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterator, Sequence
from typing import Annotated, Any

from pydantic import Field

from scan2sim.pipeline.core import optional_deps
from scan2sim.services.outbox import Deduplicator, OutboxRecord

log = logging.getLogger(__name__)

_SERVER = r"(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+)(:[0-9]{1,5})?"
Servers = Annotated[
    str,
    Field(
        pattern=f"^{_SERVER}(,{_SERVER})*$",
        json_schema_extra={"range": "HOST:PORT, or several separated by commas"},
    ),
]
"""Type of a setting: broker addresses (`bootstrap.servers`)."""
ACKNOWLEDGE_TIMEOUT_S = 10.0
"""Time for a batch to be acknowledged; after that the broker counts as lost."""
RECORD_ID_HEADER = "record id"
"""Message header with the id of the record."""
MAX_RECORD_BYTES = 2**24
"""Largest record that is sent; the broker's own limit may be lower."""


def topic_name(topic: str) -> str:
    """Kafka name of a ROS 2 topic; Kafka allows no slashes: "/robot/records" becomes "robot.records"."""
    return topic.strip("/").replace("/", ".")


class TopicProducer:
    """Sends records to a topic; its `send` is the one of an `outbox.Sender`."""

    def __init__(self, servers: str, topic: str) -> None:
        """`servers` as "host:port,host:port"; they need not be reachable yet."""
        optional_deps.require("Kafka", "confluent_kafka")
        from confluent_kafka import KafkaError, KafkaException, Producer

        self._servers, self._topic = servers, topic_name(topic)
        self._error_codes: Any = KafkaError
        self._exception: type[Exception] = KafkaException
        self._producer = Producer(
            {
                "bootstrap.servers": servers,
                "acks": "all",
                "max.in.flight.requests.per.connection": 1,  # keeps the order
                "message.timeout.ms": int(1000 * ACKNOWLEDGE_TIMEOUT_S),
                "message.max.bytes": MAX_RECORD_BYTES,
                "linger.ms": 5,
                "logger": _silent_logger(),
                "error_cb": self._on_error,
            }
        )
        self._brokers_down, self._cause = False, ""

    def _on_error(self, error: Any) -> None:
        if error.code() == self._error_codes._ALL_BROKERS_DOWN:
            self._brokers_down = True
        else:
            self._cause = self._cause or _cause(error)

    def send(self, records: Sequence[OutboxRecord]) -> None:
        """Send records in order; those that are larger than the broker accepts are dropped.

        Raises:
            ConnectionError: not all were acknowledged, or the broker was down since the previous call.
        """
        self._producer.poll(0)
        if self._brokers_down:
            self._brokers_down = False
            raise self._connection_error()
        failed: list[Any] = []

        def delivered(error: Any, _: Any) -> None:
            if error is not None and not self._is_too_large(error):
                failed.append(error)

        for record in records:
            producer_id = record.id.rpartition(":")[0]
            try:
                self._producer.produce(
                    self._topic,
                    record.body,
                    key=producer_id,
                    headers={RECORD_ID_HEADER: record.id},
                    on_delivery=delivered,
                )
            except self._exception as error:
                delivered(error.args[0], None)
        unsent = self._producer.flush(ACKNOWLEDGE_TIMEOUT_S)
        if unsent:
            self._producer.purge()
            self._producer.flush(1.0)
        if unsent or failed:
            self._cause = next((_cause(one) for one in failed if one.code() > 0), self._cause)  # > 0: the broker's own
            raise self._connection_error()
        self._cause = ""

    def _is_too_large(self, error: Any) -> bool:
        if error.code() != self._error_codes.MSG_SIZE_TOO_LARGE:
            return False
        log.warning("a record was dropped: it is larger than Kafka at %s accepts", self._servers)
        return True

    def _connection_error(self) -> ConnectionError:
        return ConnectionError(no_broker_message(self._servers, self._cause))


def no_broker_message(servers: str, cause: str) -> str:
    """Warning for the user when no broker answers."""
    return f"no Kafka at {servers} ({cause or 'no answer'}); check the address. The connection is retried"


def _cause(error: Any) -> str:
    """Cause of a librdkafka error, without the addresses and times in its text."""
    text = re.sub(r" \(after .*?\)", "", str(error.str()))
    if error.name() in ("_BAD_MSG", "_UNDERFLOW") or "ApiVersion" in text:
        return "the server there isn't Kafka"
    return text.rpartition(": ")[2]


def read(
    servers: str,
    topic: str,
    *,
    group: str,
    from_start: bool = False,
    since: float | None = None,
    connected: Callable[[bool], None] = lambda _: None,
    dropped: Callable[[str], None] = lambda _: None,
    wait: float = 1.0,
) -> Iterator[bytes | None]:
    """Iterate over the bodies of a topic's records without duplicates, forever; None after `wait` seconds without one.

    Messages without a record id (of other programs) are not deduplicated.

    Args:
        servers: as "host:port,host:port"; they need not be reachable yet.
        topic: its name; created if it doesn't exist.
        group: consumer group, whose members share the topic's records.
        from_start: start with the oldest stored record if the group is new, else with new records only.
        since: start with the records that reached Kafka at or after this time, in seconds since the epoch.
        connected: called with True when the broker has assigned the topic, with False when all brokers are down.
        dropped: called with the id of each duplicate.
        wait: seconds per poll.
    """
    optional_deps.require("Kafka", "confluent_kafka")
    from confluent_kafka import Consumer, KafkaError, KafkaException

    cause, warned = "", False

    def on_error(error: Any) -> None:
        nonlocal cause, warned
        if error.code() == KafkaError._ALL_BROKERS_DOWN:
            connected(False)
            if not warned:
                log.warning("%s", no_broker_message(servers, cause))
                warned = True
        else:
            cause = _cause(error)

    def on_assign(consumer: Any, partitions: list[Any]) -> None:
        nonlocal warned
        warned = True
        connected(True)
        if since is not None:
            for partition in partitions:
                partition.offset = int(1000 * since)
            try:
                consumer.assign(consumer.offsets_for_times(partitions, ACKNOWLEDGE_TIMEOUT_S))
            except KafkaException as error:
                log.warning("%s: earlier records are unavailable, only new ones are read (%s)", topic, error)

    consumer = Consumer(
        {
            "bootstrap.servers": servers,
            "group.id": group,
            "auto.offset.reset": "earliest" if from_start else "latest",
            "session.timeout.ms": 6000,
            "fetch.wait.max.ms": 10,
            "allow.auto.create.topics": True,
            "topic.metadata.refresh.interval.ms": 1000,  # the topic may be created later
            "logger": _silent_logger(),
            "error_cb": on_error,
        }
    )
    consumer.subscribe([topic_name(topic)], on_assign=on_assign)
    deduplicator = Deduplicator()
    try:
        while True:
            message = consumer.poll(wait)
            if message is None or message.error():
                yield None
                continue
            connected(True)
            record_id = dict(message.headers() or ()).get(RECORD_ID_HEADER)
            if not isinstance(record_id, bytes) or deduplicator.is_new(record_id.decode()):
                yield message.value()
            else:
                dropped(record_id.decode())
    finally:
        consumer.close()


def _silent_logger() -> logging.Logger:
    logger = logging.getLogger("scan2sim.kafka")
    logger.setLevel(logging.CRITICAL)
    return logger
