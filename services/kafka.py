"""Kafka: records sent to a topic, and read from it."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterator, Sequence
from typing import Annotated, Any

from pydantic import Field

from scan2sim.pipeline.core import optional_deps
from scan2sim.services.outbox import Kept, Once

log = logging.getLogger(__name__)

_SERVER = r"(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+)(:[0-9]{1,5})?"
Servers = Annotated[
    str,
    Field(
        pattern=f"^{_SERVER}(,{_SERVER})*$",
        json_schema_extra={"range": "HOST:PORT, or several of them parted by commas"},
    ),
]
"""Addresses of brokers, as a setting."""
ACKNOWLEDGED_WITHIN = 10.0
"""Seconds for a batch; then the broker counts as lost."""
ID = "record id"
"""Header of a message that holds its record's id."""


LARGEST = 2**24
"""Bytes of a record; a broker may take less."""


def topic_name(topic: str) -> str:
    """What a topic of ROS 2 is called in Kafka, which allows no slashes: "/robot/records" is "robot.records"."""
    return topic.strip("/").replace("/", ".")


class Topic:
    """Sends records to a topic, for `records.Sender`."""

    def __init__(self, servers: str, topic: str) -> None:
        """`servers` as "host:port,host:port"; they need not be there yet."""
        optional_deps.need("Kafka", "confluent_kafka")
        from confluent_kafka import KafkaError, KafkaException, Producer

        self._servers, self._topic = servers, topic_name(topic)
        self._errors: Any = KafkaError
        self._refusal: type[Exception] = KafkaException
        self._producer = Producer(
            {
                "bootstrap.servers": servers,
                "acks": "all",
                "max.in.flight.requests.per.connection": 1,  # in order
                "message.timeout.ms": int(1000 * ACKNOWLEDGED_WITHIN),
                "message.max.bytes": LARGEST,
                "linger.ms": 5,
                "logger": _silent(),
                "error_cb": self._failed,
            }
        )
        self._gone, self._cause = False, ""

    def _failed(self, error: Any) -> None:
        if error.code() == self._errors._ALL_BROKERS_DOWN:
            self._gone = True
        else:
            self._cause = self._cause or _cause(error)

    def send(self, records: Sequence[Kept]) -> None:
        """Send records in order; those that the broker will never take, as they are too large, are given up.

        Raises:
            ConnectionError: not all were acknowledged, or the broker was gone since the last ones.
        """
        self._producer.poll(0)
        if self._gone:
            self._gone = False
            raise self._no_broker()
        failed: list[Any] = []

        def delivered(error: Any, _: Any) -> None:
            if error is not None and not self._refused(error):
                failed.append(error)

        for record in records:
            maker = record.id.rpartition(":")[0]
            try:
                self._producer.produce(
                    self._topic, record.body, key=maker, headers={ID: record.id}, on_delivery=delivered
                )
            except self._refusal as error:
                delivered(error.args[0], None)
        left = self._producer.flush(ACKNOWLEDGED_WITHIN)
        if left:
            self._producer.purge()
            self._producer.flush(1.0)
        if left or failed:
            self._cause = next((_cause(one) for one in failed if one.code() > 0), self._cause)  # what the broker says
            raise self._no_broker()
        self._cause = ""

    def _refused(self, error: Any) -> bool:
        if error.code() != self._errors.MSG_SIZE_TOO_LARGE:
            return False
        log.warning("Kafka at %s takes no record as large as one that was given up", self._servers)
        return True

    def _no_broker(self) -> ConnectionError:
        return ConnectionError(no_broker(self._servers, self._cause))


def no_broker(servers: str, cause: str) -> str:
    """What a user is to know where no broker answers."""
    return f"no Kafka at {servers} ({cause or 'nothing answers'}); check the address. It is tried on"


def _cause(error: Any) -> str:
    """Of one of librdkafka's errors, without its own addresses and times."""
    text = re.sub(r" \(after .*?\)", "", str(error.str()))
    if error.name() in ("_BAD_MSG", "_UNDERFLOW") or "ApiVersion" in text:
        return "what answers there is no Kafka"
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
    """Bodies of a topic's records, each once, for ever; None after `wait` seconds without one.

    Records of no id (other programs') are handed on as they come.

    Args:
        servers: as "host:port,host:port"; they need not be there yet.
        topic: its name; it is made if it isn't there.
        group: of readers, who share a topic's records.
        from_start: begin with the oldest record that is kept, if the group is new; else with what comes.
        since: seconds since the epoch: begin with the records that came to Kafka from then on.
        connected: is called with whether the broker is there: has given the topic out, or is gone.
        dropped: is called with the ids of doubles.
        wait: seconds.
    """
    optional_deps.need("Kafka", "confluent_kafka")
    from confluent_kafka import Consumer, KafkaError, KafkaException

    cause, found = "", False

    def failed(error: Any) -> None:
        nonlocal cause, found
        if error.code() == KafkaError._ALL_BROKERS_DOWN:
            connected(False)
            if not found:
                log.warning("%s", no_broker(servers, cause))
                found = True  # is said once
        else:
            cause = _cause(error)

    def assigned(consumer: Any, partitions: list[Any]) -> None:
        nonlocal found
        found = True
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
    consumer.subscribe([topic_name(topic)], on_assign=assigned)
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
