"""Readers of Kafka start with the records since they began to read, however late their group assigns partitions."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("confluent_kafka", reason="the extra bus isn't installed")

from confluent_kafka import OFFSET_BEGINNING, OFFSET_END, OFFSET_INVALID, KafkaError, KafkaException, TopicPartition

from scan2sim.services import default_outbox, kafka
from scan2sim.services.monitoring.events import bus as bus_module
from scan2sim.services.monitoring.events.bus import Bus
from scan2sim.services.monitoring.events.schema import AlarmCommand, Events
from scan2sim.services.monitoring.settings.bus import BusParams
from scan2sim.services.outbox import OutboxRecord
from tests.fakes.broker import Broker

NO_LATER_RECORD = {"Kafka": OFFSET_END, "Tansu": 0}
"""Offset that brokers answer if a partition has no record since a time."""
ERRORS: list[KafkaException | KafkaError] = [
    KafkaException(KafkaError(KafkaError._TIMED_OUT)),
    KafkaError(KafkaError.NOT_LEADER_FOR_PARTITION),
]
"""Failures of a request: of all of it, and of its partition."""


class OnePartition:
    """A cluster with one partition and its consumer, in the test's time: `assign_next` lets the group assign it.

    Attributes:
        log: time in seconds and body of each message; None: the topic doesn't exist.
        committed_offset: of the group; None: it has committed none.
        is_reachable: whether the broker answers.
        refusals: errors of the next requests for offsets; None: it is answered.
        topic_error: of the topic's metadata.
        timeouts: of all requests for offsets, in seconds.
    """

    def __init__(self, no_later_record: int) -> None:
        self.log: list[tuple[float, bytes]] | None = []
        self.committed_offset: int | None = None
        self.is_reachable, self.timeouts = True, list[float]()
        self.refusals: list[KafkaException | KafkaError | None] = []
        self.topic_error: KafkaError | None = None
        self._no_later_record, self._position, self._is_subscribed = no_later_record, -1, False
        self._assigned_next: list[TopicPartition] | None = None

    def configured(self, _: object, __: object) -> OnePartition:
        """The consumer."""
        return self

    def append(self, seconds: float, body: bytes) -> None:
        """Append a message whose sender's clock shows now + `seconds`."""
        self.log = [*(self.log or []), (time.time() + seconds, body)]

    def assign_next(self, partitions: int = 1) -> None:
        """Assign the partition at the next poll, or none, if the group has another member."""
        self._assigned_next = [TopicPartition("t", number) for number in range(partitions)]

    def subscribe(
        self, _: list[str], on_assign: Callable[[Any, list[TopicPartition]], None], on_revoke: Callable[..., None]
    ) -> None:
        """Subscribe to the topic."""
        assert not self._is_subscribed
        self._on_assign, self._on_revoke, self._is_subscribed = on_assign, on_revoke, True

    def revoke(self) -> None:
        """Take the partition away."""
        self._position = -1
        self._on_revoke(self, [TopicPartition("t", 0)])

    def poll(self, _: float) -> Any:
        """Next message or None."""
        if self._assigned_next is not None and self._is_subscribed:
            partitions, self._assigned_next, self._position = self._assigned_next, None, -1
            self._on_assign(self, partitions)
        if not 0 <= self._position < len(self.log or []):
            return None
        assert self.log is not None
        (seconds, body), offset = self.log[self._position], self._position
        self._position += 1
        return SimpleNamespace(
            error=lambda: None, timestamp=lambda: (1, int(1000 * seconds)), value=lambda: body, headers=lambda: None,
            partition=lambda: 0, offset=lambda: offset,
        )  # fmt: skip

    def committed(self, _: list[TopicPartition], timeout: float) -> list[Any]:
        """Offset that the group has committed."""
        return self._answer(timeout, OFFSET_INVALID if self.committed_offset is None else self.committed_offset)

    def offsets_for_times(self, asked: list[TopicPartition], timeout: float) -> list[Any]:
        """First message since a time in milliseconds, or the end."""
        ((one,), log) = asked, self.log or []
        later = [number for number, (seconds, _) in enumerate(log) if int(1000 * seconds) >= one.offset]
        end = one.offset == OFFSET_END
        return self._answer(timeout, len(log) if end else later[0] if later else self._no_later_record)

    def _answer(self, timeout: float, offset: int) -> list[Any]:
        self.timeouts.append(timeout)
        error = self.refusals.pop(0) if self.refusals else None
        if isinstance(error, KafkaException):
            raise error
        if error is not None:
            return [SimpleNamespace(topic="t", partition=0, offset=OFFSET_INVALID, error=error)]
        return [TopicPartition("t", 0, offset)]

    def assign(self, partitions: Sequence[TopicPartition]) -> None:
        """Read on from an offset that exists."""
        assert all(one.offset == OFFSET_BEGINNING or 0 <= one.offset <= len(self.log or []) for one in partitions)
        self._position = max(0, partitions[0].offset) if partitions else -1

    def assignment(self) -> list[TopicPartition]:
        """What is assigned."""
        return [TopicPartition("t", 0)] if self._position >= 0 else []

    def list_topics(self, topic: str, timeout: float) -> Any:
        """Metadata of the topic, if the broker answers."""
        if not self.is_reachable:
            raise KafkaException(KafkaError(KafkaError._TRANSPORT))
        missing = KafkaError(KafkaError.UNKNOWN_TOPIC_OR_PART) if self.log is None else None
        error = self.topic_error or missing
        return SimpleNamespace(topics={topic: SimpleNamespace(error=error, partitions={} if error else {0: None})})

    def close(self) -> None:
        """Nothing to close."""


def reader_of(cluster: OnePartition, **arguments: Any) -> Iterator[bytes | None]:
    """A reader that has begun to read."""
    bodies = kafka.read(cluster, "t", group="g", **arguments)  # type: ignore[arg-type]
    assert next(bodies) is None
    return bodies


def bodies_now(bodies: Iterator[bytes | None], polls: int = 10) -> list[bytes]:
    """All records that a reader yields within a number of polls."""
    return [body for body in (next(bodies) for _ in range(polls)) if body]


@pytest.fixture(params=sorted(NO_LATER_RECORD))
def cluster(request: pytest.FixtureRequest) -> OnePartition:
    """A cluster like Kafka, and one like Tansu."""
    return OnePartition(NO_LATER_RECORD[request.param])


@pytest.mark.parametrize("skew", [1.0, -10.0, 3600.0], ids=["right clock", "slow clock", "fast clock"])
def test_record_that_arrives_before_the_partition_is_assigned_is_read(cluster: OnePartition, skew: float) -> None:
    cluster.append(-60, b"earlier")
    cluster.append(3600, b"earlier, by a fast clock")
    cluster.append(-50, b"earlier")
    bodies = reader_of(cluster)
    assert bodies_now(bodies) == []
    cluster.append(skew, b"new")
    cluster.assign_next()
    assert bodies_now(bodies) == [b"new"]
    cluster.append(skew, b"newer")
    assert bodies_now(bodies) == [b"newer"]


def test_topic_that_is_created_later_is_read_from_its_start(cluster: OnePartition) -> None:
    cluster.log = None
    bodies = reader_of(cluster)
    cluster.append(-10, b"first")
    cluster.assign_next()
    assert bodies_now(bodies) == [b"first"]


def test_reader_without_a_broker_starts_at_its_first_answer(cluster: OnePartition) -> None:
    cluster.append(3600, b"earlier")
    cluster.is_reachable = False
    bodies = reader_of(cluster)
    cluster.append(1, b"before the answer")  # can't be distinguished from an earlier one
    assert bodies_now(bodies) == []
    cluster.is_reachable = True
    assert next(bodies) is None
    cluster.append(-10, b"new")
    cluster.assign_next()
    assert bodies_now(bodies) == [b"new"]


@pytest.mark.parametrize("error", ERRORS)
def test_refused_request_for_the_ends_is_retried(cluster: OnePartition, error: KafkaException | KafkaError) -> None:
    cluster.append(3600, b"earlier")
    cluster.refusals.append(error)
    bodies = reader_of(cluster)
    assert bodies_now(bodies) == []
    cluster.append(-10, b"new")
    cluster.assign_next()
    assert bodies_now(bodies) == [b"new"]


def test_topic_that_may_not_be_read_yet_is_not_taken_for_a_new_one(cluster: OnePartition) -> None:
    cluster.append(3600, b"earlier")
    cluster.topic_error = KafkaError(KafkaError.TOPIC_AUTHORIZATION_FAILED)
    signs, states = list[None](), list[bool]()
    bodies = reader_of(cluster, reached=lambda: signs.append(None), connected=states.append)
    assert bodies_now(bodies) == [] and signs and True not in states
    cluster.topic_error = None
    assert next(bodies) is None
    cluster.append(1, b"new")
    cluster.assign_next()
    assert bodies_now(bodies) == [b"new"]


@pytest.mark.parametrize("refused", ["committed offsets", "ends"])
@pytest.mark.parametrize("error", ERRORS)
def test_failed_assignment_is_retried(cluster: OnePartition, refused: str, error: KafkaException | KafkaError) -> None:
    cluster.append(3600, b"earlier")
    states = list[bool]()
    bodies = reader_of(cluster, connected=states.append)
    cluster.append(1, b"new")
    cluster.assign_next()
    attempt: list[KafkaException | KafkaError | None] = [None] if refused == "ends" else []
    cluster.refusals = [*attempt, error, *attempt, error]
    assert next(bodies) is None and not cluster.assignment() and True not in states
    assert bodies_now(bodies) == [b"new"] and states[-1] and not cluster.refusals


def test_partition_that_is_revoked_is_not_assigned_again(cluster: OnePartition) -> None:
    bodies = reader_of(cluster)
    cluster.refusals = [ERRORS[1], ERRORS[1]]
    cluster.assign_next()
    assert next(bodies) is None and not cluster.assignment()
    cluster.revoke()
    cluster.append(1, b"of another member")
    assert bodies_now(bodies) == []


@pytest.mark.parametrize("since", [None, 150.0])
def test_assignment_takes_three_seconds_at_most(cluster: OnePartition, since: float | None) -> None:
    bodies = reader_of(cluster, since=since)
    cluster.timeouts.clear()
    cluster.assign_next()
    next(bodies)
    assert len(cluster.timeouts) >= 2 and sum(cluster.timeouts) <= 3.0


def test_assignment_of_no_partition_is_no_connection(cluster: OnePartition) -> None:
    states = list[bool]()
    bodies = reader_of(cluster, connected=states.append)
    cluster.assign_next(0)
    assert bodies_now(bodies) == [] and True not in states
    cluster.assign_next()
    assert bodies_now(bodies) == [] and states[-1]


@pytest.mark.parametrize("read", [0, 1])
def test_records_after_an_outage_that_lost_all_are_read(cluster: OnePartition, read: int) -> None:
    for _ in range(3):
        cluster.append(-60, b"earlier")
    bodies = reader_of(cluster)
    cluster.assign_next()
    assert bodies_now(bodies) == []
    for _ in range(read):
        cluster.append(1, b"before")
        assert bodies_now(bodies) == [b"before"]
    cluster.log = []
    cluster.append(-60, b"after")
    cluster.append(61, b"killed since")  # by a node that is gone
    cluster.assign_next()
    assert bodies_now(bodies) == [b"after", b"killed since"]


def test_reader_continues_where_it_was_if_its_group_has_committed_nothing(cluster: OnePartition) -> None:
    bodies = reader_of(cluster)
    cluster.append(1, b"read")
    cluster.assign_next()
    assert bodies_now(bodies) == [b"read"]
    cluster.append(1, b"meanwhile")
    cluster.assign_next()
    assert bodies_now(bodies) == [b"meanwhile"]


def test_group_continues_where_it_was(cluster: OnePartition) -> None:
    cluster.append(-60, b"read")
    cluster.append(-50, b"unread")
    cluster.committed_offset = 1
    cluster.assign_next()
    assert bodies_now(reader_of(cluster)) == [b"unread"]


def test_reader_of_everything_starts_at_the_oldest_record(cluster: OnePartition) -> None:
    cluster.append(-60, b"oldest")
    cluster.assign_next()
    assert bodies_now(reader_of(cluster, from_start=True)) == [b"oldest"]


def test_records_since_a_time_are_read_with_those_of_slow_clocks_between_them(cluster: OnePartition) -> None:
    cluster.log = [(100.0, b"earlier"), (200.0, b"since"), (50.0, b"slow"), (201.0, b"last")]
    cluster.assign_next()
    assert bodies_now(reader_of(cluster, since=150.0)) == [b"since", b"slow", b"last"]


def test_records_since_a_time_without_any_are_the_new_ones(cluster: OnePartition) -> None:
    cluster.log = [(100.0, b"earlier"), (110.0, b"earlier")]
    cluster.assign_next()
    bodies = reader_of(cluster, since=150.0)
    assert bodies_now(bodies) == []
    cluster.log.append((50.0, b"slow"))
    assert bodies_now(bodies) == [b"slow"]


def test_earlier_records_are_skipped_by_a_later_assignment_too() -> None:
    cluster = OnePartition(NO_LATER_RECORD["Tansu"])
    cluster.log = [(100.0, b"earlier"), (110.0, b"earlier")]
    cluster.assign_next()
    bodies = reader_of(cluster, since=150.0)
    assert next(bodies) is None
    cluster.assign_next()
    assert bodies_now(bodies) == []


def test_nothing_is_skipped_where_the_group_has_read() -> None:
    cluster = OnePartition(NO_LATER_RECORD["Tansu"])
    cluster.log = [(100.0, b"earlier"), (50.0, b"unread")]
    cluster.assign_next()
    bodies = reader_of(cluster, since=150.0)
    assert next(bodies) is None
    cluster.committed_offset = 1
    cluster.assign_next()
    assert bodies_now(bodies) == [b"unread"]


def test_callers_can_stop_while_earlier_records_are_skipped() -> None:
    cluster = OnePartition(NO_LATER_RECORD["Tansu"])
    cluster.log = [(100.0, b"earlier")] * 5
    cluster.assign_next()
    bodies = reader_of(cluster, since=150.0)
    for read in range(1, 6):
        assert next(bodies) is None and cluster._position == read


@pytest.fixture
def bus(monkeypatch: pytest.MonkeyPatch) -> Bus:
    """The bus of a node without a transport, whose records aren't sent."""
    sink = SimpleNamespace(send=lambda _: None, close=lambda: None)
    monkeypatch.setattr(bus_module, "KafkaSink", lambda *_: sink)
    monkeypatch.setattr(default_outbox, "open_outbox", lambda *_: None)
    node = SimpleNamespace(
        get_name=lambda: "alarms", get_namespace=lambda: "/", create_publisher=lambda *_: None,
        create_subscription=lambda *_: None,
    )  # fmt: skip
    return Bus(node, BusParams(kafka_bootstrap_servers="localhost:1"))


def test_bus_reads_only_when_its_callbacks_are_registered(bus: Bus, monkeypatch: pytest.MonkeyPatch) -> None:
    command, called = AlarmCommand(action="retire", subject="/camera"), list[AlarmCommand]()
    message = Events("operator").send("alarm_command", command).json_line().encode()
    monkeypatch.setattr(kafka, "read", lambda *_, **__: iter([None, message]))
    time.sleep(0.05)
    bus.events.on("alarm_command", called.append)
    assert called == []
    bus.start()
    bus.close()
    assert called == [command]


def test_bus_that_only_sends_is_closed_without_a_start(bus: Bus) -> None:
    bus.close()


def test_real_broker_delivers_what_arrives_before_the_assignment(broker: Broker) -> None:
    producer, signs = kafka.TopicProducer(broker.cluster, "t"), list[None]()
    producer.send([OutboxRecord(1, "a:1", b"earlier")])
    bodies = kafka.read(broker.cluster, "t", group="g", wait=0.1, reached=lambda: signs.append(None))
    while not signs:
        assert next(bodies) is None
    producer.send([OutboxRecord(2, "a:2", b"new")])
    assert next(body for body in bodies if body) == b"new"
