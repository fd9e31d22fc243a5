"""Kafka producer and consumer of records, with retries and deduplication by record id."""

from __future__ import annotations

import logging
import os
import re
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from scan2sim.pipeline.core import optional_deps
from scan2sim.pipeline.core.errors import InputError
from scan2sim.services.outbox import Deduplicator, OutboxRecord, is_record_id

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
ClientConfig = Annotated[
    Path | None,
    Field(
        description="File with options of the Kafka client (librdkafka), KEY=VALUE per line, such as TLS and SASL"
        " (docs/monitoring.md); default: $SCAN2SIM_KAFKA_CONFIG."
    ),
]
"""Type of a setting: file with options of librdkafka."""
ACKNOWLEDGE_TIMEOUT_S = 10.0
"""Time for a batch to be acknowledged; after that the broker counts as lost."""
RECORD_ID_HEADER = "record id"
"""Message header with the id of the record."""
MAX_RECORD_BYTES = 2**24
"""Largest record that is sent; the broker's own limit may be lower."""


CONFIG_VARIABLE = "SCAN2SIM_KAFKA_CONFIG"
"""Environment variable with the default of settings of type `ClientConfig`."""
PROBE_TIMEOUT_S = 1.0
"""Time for an idle broker to answer; after that it counts as unreachable."""
FIRST_ANSWER_TIMEOUT_S = 3.0
"""Time for the broker to answer a reader that starts; after that the reader starts without its answer."""
FIRST_PROBE_PAUSE_S, MAX_PROBE_PAUSE_S = 0.5, 5.0
"""Pause until an idle broker is probed again; doubled each time that it answers, up to a maximum."""
CLOSE_TIMEOUT_S = 10.0
"""Time for a consumer to leave its group and to close."""


@dataclass(frozen=True)
class Cluster:
    """A Kafka cluster and how to connect to it.

    Attributes:
        servers: as "host:port,host:port"; they need not be reachable yet.
        options: of librdkafka, in addition to those that this module sets.
        config: file that `options` were read from, for messages.
    """

    servers: str
    options: Mapping[str, str] = field(default_factory=dict)
    config: Path | None = None

    @classmethod
    def read(cls, servers: str, config: Path | None) -> Cluster:
        """Cluster with the options of a file; without `config`, of the one that `SCAN2SIM_KAFKA_CONFIG` names, if any.

        Raises:
            InputError: the file can't be read, or has a line that isn't KEY=VALUE.
        """
        named = os.environ.get(CONFIG_VARIABLE)
        path = config or (Path(named) if named else None)
        return cls(servers, _options(path) if path else {}, path)

    def configured(self, client: Callable[[dict[str, Any]], Any], own: Mapping[str, Any]) -> Any:
        """Create a client of confluent_kafka with the cluster's options; `own` has priority.

        Raises:
            InputError: librdkafka rejects an option.
        """
        from confluent_kafka import KafkaException

        try:
            return client({**self.options, "bootstrap.servers": self.servers, **own})
        except KafkaException as error:
            if self.config is None:
                raise
            remedy = "Its keys are those of librdkafka (CONFIGURATION.md), not of Kafka's Java client"
            raise InputError(self.config, str(error.args[0].str()), remedy) from None


def _options(path: Path) -> dict[str, str]:
    """Options of a properties file: KEY=VALUE per line, `#` begins a comment line."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        cause = error.strerror if isinstance(error, OSError) else "not a text file"
        raise InputError(path, f"can't be read ({cause})", "Name a file with KEY=VALUE per line") from None
    options = {}
    for number, line in enumerate(lines, 1):
        if line.strip() and not line.lstrip().startswith("#"):
            key, separator, value = line.partition("=")
            if not separator:
                raise InputError(path, f"line {number} isn't KEY=VALUE", "Write for example: security.protocol=SSL")
            options[key.strip()] = value.strip()
    return options


def topic_name(topic: str) -> str:
    """Kafka name of a ROS 2 topic; Kafka allows no slashes: "/robot/records" becomes "robot.records"."""
    return topic.strip("/").replace("/", ".")


class TopicProducer:
    """Sends records to a topic; its `send` is the one of an `outbox.Sender`."""

    def __init__(self, cluster: Cluster, topic: str) -> None:
        """Create it; the cluster need not be reachable yet.

        Raises:
            InputError: librdkafka rejects one of the cluster's options.
        """
        optional_deps.require("Kafka", "confluent_kafka")
        from confluent_kafka import KafkaError, KafkaException, Producer

        self._servers, self._topic = cluster.servers, topic_name(topic)
        self._error_codes: Any = KafkaError
        self._exception: type[Exception] = KafkaException
        self._producer = cluster.configured(
            Producer,
            {
                "acks": "all",
                "max.in.flight.requests.per.connection": 1,  # keeps the order
                "message.timeout.ms": int(1000 * ACKNOWLEDGE_TIMEOUT_S),
                "message.max.bytes": MAX_RECORD_BYTES,
                "linger.ms": 5,
                "logger": _silent_logger(),
                "error_cb": self._on_error,
            },
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
    if "OAUTHBEARER token" in text:
        return f"the token endpoint answers {text.partition(': ')[2]}"
    return text.rpartition(": ")[2]


def read(
    cluster: Cluster,
    topic: str,
    *,
    group: str,
    from_start: bool = False,
    since: float | None = None,
    connected: Callable[[bool], None] = lambda _: None,
    reached: Callable[[], None] = lambda: None,
    dropped: Callable[[str], None] = lambda _: None,
    rejected: Callable[[str], None] = lambda _: None,
    max_probe_pause: float = MAX_PROBE_PAUSE_S,
    wait: float = 1.0,
) -> Iterator[bytes | None]:
    """Iterate over the bodies of a topic's records without duplicates, forever; None after `wait` seconds without one.

    Messages without a record id (of other programs) are not deduplicated; those without a body, or with a record id
    that this program doesn't write, are skipped.

    The first item is None: from then on no record is missed, unless the broker hasn't answered yet.

    Args:
        cluster: need not be reachable yet.
        topic: its name; created if it doesn't exist.
        group: consumer group, whose members share the topic's records.
        from_start: start with the oldest stored record where the group has read nothing, unless `since` is given.
        since: start with the records that reached Kafka at or after this time, in seconds since the epoch and by the
            senders' clocks, where the group has read nothing; default, without `from_start`: with those that reach
            Kafka after its first answer to this reader (`_Start`).
        connected: called with True while the broker has assigned partitions and answers, otherwise with False; at once
            if connections break, otherwise at the next probe.
        reached: called at each sign that a broker is there: a message, or an answer while there are none.
        max_probe_pause: longest pause in seconds between two probes of an idle broker, which take `PROBE_TIMEOUT_S` if
            it hangs.
        dropped: called with the id of each duplicate.
        rejected: called with the reason for each message that is skipped.
        wait: seconds per poll.

    Raises:
        InputError: librdkafka rejects one of the cluster's options.
    """
    optional_deps.require("Kafka", "confluent_kafka")
    from confluent_kafka import Consumer, KafkaError, KafkaException

    name, start, probe = topic_name(topic), _Start(since, from_start=from_start), _Probe(max_probe_pause)
    cause, warned, failure, subscribed, unassigned = "", False, "", False, list[Any]()

    def on_error(error: Any) -> None:
        nonlocal cause, warned
        if error.code() == KafkaError._ALL_BROKERS_DOWN:
            connected(False)
            probe.failed()
            if not warned:
                log.warning("%s", no_broker_message(cluster.servers, cause))
                warned = True
        else:
            cause = _cause(error)

    def on_assign(_: Any, partitions: list[Any]) -> None:
        nonlocal warned
        warned, unassigned[:] = True, partitions
        proceed()
        connected(bool(partitions) and not unassigned)

    def proceed() -> None:
        """Subscribe to the topic, or assign its partitions; what fails is retried at the next probe."""
        nonlocal subscribed, failure
        try:
            if not subscribed:
                start.begin(consumer, name)
                consumer.subscribe([name], on_assign=on_assign, on_revoke=lambda *_: unassigned.clear())
                subscribed = True
            elif unassigned:
                start.assign(consumer, unassigned)
                unassigned.clear()
        except KafkaException as error:
            probe.failed()
            if subscribed:
                consumer.assign([])  # otherwise librdkafka starts where it likes
            if failure != (failure := _cause(error.args[0])):
                log.warning("%s can't be read yet (%s); this is retried", topic, failure)

    def contact(timeout: float = PROBE_TIMEOUT_S) -> None:
        """Ask the broker whether it is there."""
        if answers := _answers(consumer, name, timeout):
            reached()
            probe.succeeded()
            proceed()
        else:
            probe.failed()
        connected(answers and bool(consumer.assignment()))

    consumer = cluster.configured(
        Consumer,
        {
            "group.id": group,
            "auto.offset.reset": "earliest",  # if the broker no longer has the record at an offset of `_Start`
            "session.timeout.ms": 6000,
            "fetch.wait.max.ms": 10,
            "allow.auto.create.topics": True,
            "topic.metadata.refresh.interval.ms": 1000,  # the topic may be created later
            "logger": _silent_logger(),
            "error_cb": on_error,
        },
    )
    deduplicator = Deduplicator()
    try:
        contact(FIRST_ANSWER_TIMEOUT_S)
        yield None
        while True:
            message = consumer.poll(wait)
            if message is None or message.error():
                if probe.is_due():
                    contact()
                yield None
                continue
            reached()
            connected(True)
            header, body = dict(message.headers() or ()).get(RECORD_ID_HEADER), message.value()
            record_id = None if header is None else _record_id(header)
            if start.skips(message):
                body = None
            elif not body:
                rejected("a message without a body")
            elif header is not None and record_id is None:
                rejected(f"a header {RECORD_ID_HEADER!r} of another program")
                body = None
            elif record_id is not None and not deduplicator.is_new(record_id):
                dropped(record_id)
                body = None
            yield body or None  # None for what is skipped, too: the caller may want to stop
    finally:
        _close(consumer)


class _Start:
    """Where a consumer starts in partitions of which its group has read nothing: where it was, else where it began.

    Unless it began at the oldest record or at a given time, it began at the ends that the partitions had when the
    broker first answered. A time wouldn't do, as messages have those of their senders' clocks: old commands by a fast
    clock would be executed again, and new ones by a slow clock missed. Records that reached Kafka before that answer
    aren't read, even if this program was already running: they can't be distinguished from older ones.
    """

    def __init__(self, since: float | None, *, from_start: bool) -> None:
        """`since`: seconds since the epoch; None: from the start or the ends."""
        self._since_ms = None if since is None else int(1000 * since)
        self._from_end = since is None and not from_start
        self._next = dict[int, int]()  # offset of the next message, by partition; others start at their first
        self._unverified = dict[int, int]()  # end of the partition when it was assigned

    def begin(self, consumer: Any, topic: str) -> None:
        """Note the ends of the partitions that a topic has, if any, before it is subscribed to.

        Raises:
            KafkaException: the broker doesn't answer, or refuses.
        """
        from confluent_kafka import OFFSET_END, KafkaError, KafkaException, TopicPartition

        if not self._from_end:
            return
        found = consumer.list_topics(topic, timeout=PROBE_TIMEOUT_S).topics.get(topic)
        if found is None:
            return
        # the second is the answer of some versions of Kafka while they create the topic
        is_new = (KafkaError.UNKNOWN_TOPIC_OR_PART, KafkaError.LEADER_NOT_AVAILABLE)
        if found.error is not None and found.error.code() not in is_new:
            raise KafkaException(found.error)
        self._next = _offsets_at(consumer, [TopicPartition(topic, number) for number in found.partitions], OFFSET_END)

    def assign(self, consumer: Any, partitions: Sequence[Any]) -> None:
        """Assign partitions at their starting offsets; takes at most 3 `PROBE_TIMEOUT_S`.

        Raises:
            KafkaException: the broker doesn't answer, or refuses.
        """
        from confluent_kafka import OFFSET_BEGINNING, OFFSET_END

        self._unverified.clear()
        committed = _without_errors(consumer.committed(partitions, PROBE_TIMEOUT_S))
        unread = [one for one in committed if one.offset < 0]
        ends = _offsets_at(consumer, unread, OFFSET_END)
        times = dict[int, int]()
        if self._since_ms is not None:  # after the ends, so that what arrives in between is read
            new = [one for one in unread if one.partition not in self._next]
            times = _offsets_at(consumer, new, self._since_ms)
        for one in unread:
            number, end = one.partition, ends[one.partition]
            if number in times:
                one.offset = end if times[number] == OFFSET_END else times[number]  # OFFSET_END: no record since then
                self._unverified[number] = end
            elif self._next.get(number, 0) > end:  # the broker has lost its records, and others have come
                one.offset = self._next[number] = 0
            else:
                one.offset = self._next.get(number, OFFSET_BEGINNING)
        consumer.assign(committed)

    def skips(self, message: Any) -> bool:
        """Whether the next message is from before the start: some brokers (Tansu) answer offset 0 if none is later.

        Only the first messages of a partition can be: a time is that of the sender's clock, which may be slow.
        """
        number, offset, (kind, time_ms) = message.partition(), message.offset(), message.timestamp()
        is_old = offset < self._unverified.get(number, 0)
        if is_old and kind and time_ms < (self._since_ms or 0):  # kind 0: the message has no time
            return True
        self._unverified.pop(number, None)
        self._next[number] = offset + 1
        return False


def _offsets_at(consumer: Any, partitions: Sequence[Any], time_ms: int) -> dict[int, int]:
    """Offset of the first record since a time, in each partition.

    Raises:
        KafkaException: the broker doesn't answer, or refuses.
    """
    from confluent_kafka import TopicPartition

    asked = [TopicPartition(one.topic, one.partition, time_ms) for one in partitions]
    found = consumer.offsets_for_times(asked, PROBE_TIMEOUT_S) if asked else []
    return {one.partition: one.offset for one in _without_errors(found)}


def _without_errors(partitions: list[Any]) -> list[Any]:
    """Partitions of an answer.

    Raises:
        KafkaException: the answer is an error for one of them.
    """
    from confluent_kafka import KafkaException

    for one in partitions:
        if one.error is not None:
            raise KafkaException(one.error)
    return partitions


def _close(consumer: Any, timeout: float = CLOSE_TIMEOUT_S) -> None:
    """Leave the group and free the consumer; one that librdkafka doesn't close in time is left to the process's end.

    librdkafka can wait forever in it, for example if the broker went away (its issue 4519); no signal interrupts it.
    """
    closing = threading.Thread(target=consumer.close, name="close Kafka consumer", daemon=True)
    try:
        closing.start()
    except RuntimeError:  # Python is ending
        return
    closing.join(timeout)
    if closing.is_alive():
        log.warning("Kafka: the consumer did not close within %g s; its group notices that after some seconds", timeout)


def _record_id(header: bytes) -> str | None:
    """Record id of a message's header; None: it isn't one."""
    text = header.decode("ascii", "replace")
    return text if is_record_id(text) else None


def process(body: bytes, callback: Callable[[bytes], None], rejected: Callable[[str], None]) -> None:
    """Call `callback` with a record's body; one that it fails on is rejected, so that it doesn't stop the reader."""
    try:
        callback(body)
    except Exception as error:
        log.exception("a record could not be processed: %.200r", body)
        rejected(f"could not be processed: {error!r:.200}")


class _Probe:
    """When an idle broker is to be asked whether it is there: at every poll, and less often while it answers."""

    def __init__(self, max_pause: float, clock: Callable[[], float] = time.monotonic) -> None:
        """`max_pause`: seconds."""
        self._max_pause, self._pause, self._due = max_pause, FIRST_PROBE_PAUSE_S, 0.0
        self._clock = clock

    def is_due(self) -> bool:
        """Whether to ask now."""
        return self._clock() >= self._due

    def succeeded(self) -> None:
        """It has answered."""
        self._due = self._clock() + self._pause
        self._pause = min(self._max_pause, 2 * self._pause)

    def failed(self) -> None:
        """It is unreachable."""
        self._pause, self._due = FIRST_PROBE_PAUSE_S, 0.0


def _answers(consumer: Any, topic: str, timeout: float) -> bool:
    """Whether the broker of an idle consumer answers within some seconds."""
    from confluent_kafka import KafkaException

    try:
        consumer.list_topics(topic, timeout=timeout)
    except KafkaException:
        return False
    return True


def _silent_logger() -> logging.Logger:
    logger = logging.getLogger("scan2sim.kafka")
    logger.setLevel(logging.CRITICAL)
    return logger
