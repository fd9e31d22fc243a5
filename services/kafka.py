"""Kafka: records sent to a topic, and read from it."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from scan2sim.pipeline import extras
from scan2sim.services.records import Kept, Once

log = logging.getLogger(__name__)

ACKNOWLEDGED_WITHIN = 10.0
"""Seconds for a batch; then the broker counts as lost."""
ID = "record id"
"""Header of a message that holds its record's id."""


class Topic:
    """Sends records to a topic, for `records.Sender`."""

    def __init__(self, servers: str, topic: str) -> None:
        """`servers` as "host:port,host:port"; they need not be there yet."""
        extras.need("Kafka", "confluent_kafka")
        from confluent_kafka import Producer

        self._servers, self._topic = servers, topic
        self._producer = Producer(
            {
                "bootstrap.servers": servers,
                "acks": "all",
                "max.in.flight.requests.per.connection": 1,  # in order
                "message.timeout.ms": int(1000 * ACKNOWLEDGED_WITHIN),
                "message.max.bytes": 2**24,
                "linger.ms": 5,
                "logger": _silent(),
                "error_cb": self._failed,
            }
        )
        self._gone = False

    def _failed(self, error: Any) -> None:
        from confluent_kafka import KafkaError

        self._gone |= error.code() == KafkaError._ALL_BROKERS_DOWN

    def send(self, records: Sequence[Kept]) -> None:
        """Send records in order.

        Raises:
            ConnectionError: not all were acknowledged, or the broker was gone since the last ones.
        """
        self._producer.poll(0)
        if self._gone:
            self._gone = False
            raise ConnectionError(f"the broker at {self._servers} went away")
        failed: list[str] = []

        def delivered(error: Any, _: Any) -> None:
            if error is not None:
                failed.append(str(error))

        for record in records:
            maker = record.id.rpartition(":")[0]
            self._producer.produce(self._topic, record.body, key=maker, headers={ID: record.id}, on_delivery=delivered)
        left = self._producer.flush(ACKNOWLEDGED_WITHIN)
        if left:
            self._producer.purge()
            self._producer.flush(1.0)
        if left or failed:
            raise ConnectionError(f"no broker at {self._servers} ({failed[0] if failed else 'no answer'})")


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
    """Bodies of a topic's records, each once, for ever; None after `wait` seconds without one.

    Records of no id (other programs') are handed on as they come.

    Args:
        servers: as "host:port,host:port"; they need not be there yet.
        topic: its name; it is made if it isn't there.
        group: of readers, who share a topic's records.
        from_start: begin with the oldest record that is kept, if the group is new; else with what comes.
        since: seconds since the epoch: begin with the records that came to Kafka from then on.
        connected: is told when the broker has given the topic out, and when it is gone.
        dropped: is told the ids of doubles.
        wait: seconds.
    """
    extras.need("Kafka", "confluent_kafka")
    from confluent_kafka import Consumer, KafkaError, KafkaException

    def failed(error: Any) -> None:
        if error.code() == KafkaError._ALL_BROKERS_DOWN:
            connected(False)

    def assigned(consumer: Any, partitions: list[Any]) -> None:
        connected(True)
        if since is not None:
            for one in partitions:
                one.offset = int(1000 * since)
            try:
                consumer.assign(consumer.offsets_for_times(partitions, ACKNOWLEDGED_WITHIN))
            except KafkaException as error:
                log.warning("%s: earlier records can't be had, only what comes (%s)", topic, error)

    consumer = Consumer(
        {
            "bootstrap.servers": servers,
            "group.id": group,
            "auto.offset.reset": "earliest" if from_start else "latest",
            "session.timeout.ms": 6000,
            "fetch.wait.max.ms": 10,
            "allow.auto.create.topics": True,
            "topic.metadata.refresh.interval.ms": 1000,  # a topic may come later
            "logger": _silent(),
            "error_cb": failed,
        }
    )
    consumer.subscribe([topic], on_assign=assigned)
    once = Once()
    try:
        while True:
            message = consumer.poll(wait)
            if message is None or message.error():
                yield None
                continue
            connected(True)
            record_id = dict(message.headers() or ()).get(ID)
            if not isinstance(record_id, bytes) or once.new(record_id.decode()):
                yield message.value()
            else:
                dropped(record_id.decode())
    finally:
        consumer.close()


def _silent() -> logging.Logger:
    logger = logging.getLogger("scan2sim.kafka")
    logger.setLevel(logging.CRITICAL)
    return logger
