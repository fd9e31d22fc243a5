"""Readers of Kafka start with the records since they began to read, however late their group assigns partitions."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("confluent_kafka", reason="the extra bus isn't installed")

from confluent_kafka import OFFSET_END, OFFSET_INVALID, KafkaError, TopicPartition

from scan2sim.services import kafka
from scan2sim.services.outbox import OutboxRecord
from tests.fakes.broker import Broker

NO_LATER_RECORD = {"Kafka": OFFSET_END, "Tansu": 0}
"""Offset that brokers answer if a partition has no record since a time."""


class OnePartition:
    """A cluster with one partition and its consumer, in the test's time: `assign_next` lets the group assign it.

    Attributes:
        log: time in seconds and body of each message.
        committed_offset: of the group; None: it has committed none.
    """

    def __init__(self, no_later_record: int) -> None:
        self.log: list[tuple[float, bytes]] = []
        self.committed_offset: int | None = None
        self._no_later_record, self._position, self._is_due, self._is_at_end = no_later_record, -1, False, False

    def configured(self, _: object, __: object) -> OnePartition:
        """The consumer."""
        return self

    def assign_next(self) -> None:
        """Assign the partition at the next poll."""
        self._is_due = True

    def subscribe(self, _: list[str], on_assign: Callable[[Any, list[TopicPartition]], None]) -> None:
        """Subscribe to the topic."""
        self._on_assign = on_assign

    def poll(self, _: float) -> Any:
        """Next message, the partition's end once, or None."""
        if self._is_due:
            self._is_due, self._position = False, -1
            partitions = [TopicPartition("t", 0)]
            self._on_assign(self, partitions)
            if self._position < 0:
                self.assign(self.committed(partitions, 1.0))
        if self._position < 0:
            return None
        if self._position < len(self.log):
            seconds, body = self.log[self._position]
            self._position, self._is_at_end = self._position + 1, False
            return _message(lambda: None, (1, int(1000 * seconds)), body)
        if not self._is_at_end:
            self._is_at_end = True
            return _message(lambda: KafkaError(KafkaError._PARTITION_EOF), (0, 0), b"")
        return None

    def committed(self, _: list[TopicPartition], __: float) -> list[TopicPartition]:
        """Offset that the group has committed."""
        return [TopicPartition("t", 0, OFFSET_INVALID if self.committed_offset is None else self.committed_offset)]

    def offsets_for_times(self, asked: list[TopicPartition], _: float) -> list[TopicPartition]:
        """First message since a time in milliseconds, or the end."""
        (one,) = asked
        later = [number for number, (seconds, _) in enumerate(self.log) if int(1000 * seconds) >= one.offset]
        end = one.offset == OFFSET_END
        return [TopicPartition("t", 0, len(self.log) if end else later[0] if later else self._no_later_record)]

    def assign(self, partitions: list[TopicPartition]) -> None:
        """Read on from an offset; without one from the end (`auto.offset.reset`)."""
        (one,) = partitions
        self._position, self._is_at_end = (one.offset if one.offset >= 0 else len(self.log)), False

    def assignment(self) -> list[TopicPartition]:
        """What is assigned."""
        return [TopicPartition("t", 0)] if self._position >= 0 else []

    def list_topics(self, _: str, timeout: float) -> None:
        """The broker answers."""

    def close(self) -> None:
        """Nothing to close."""


def _message(error: Callable[[], Any], timestamp: tuple[int, int], body: bytes) -> Any:
    return SimpleNamespace(
        error=error, timestamp=lambda: timestamp, value=lambda: body, headers=lambda: None, partition=lambda: 0
    )


def bodies_now(bodies: Iterator[bytes | None]) -> list[bytes]:
    """All records that a reader yields until it has none."""
    return list(iter(lambda: next(bodies), None))


@pytest.fixture(params=sorted(NO_LATER_RECORD))
def cluster(request: pytest.FixtureRequest) -> OnePartition:
    """A cluster like Kafka, and one like Tansu."""
    return OnePartition(NO_LATER_RECORD[request.param])


def test_record_that_arrives_before_the_partition_is_assigned_is_read(cluster: OnePartition) -> None:
    cluster.log += [(time.time() - 60, b"earlier"), (time.time() - 50, b"earlier")]
    bodies = kafka.read(cluster, "t", group="g")  # type: ignore[arg-type]
    assert bodies_now(bodies) == []
    cluster.log.append((time.time() + 1, b"new"))
    cluster.assign_next()
    assert bodies_now(bodies) == [b"new"]


def test_records_after_an_outage_that_lost_all_are_read(cluster: OnePartition) -> None:
    bodies = kafka.read(cluster, "t", group="g")  # type: ignore[arg-type]
    cluster.assign_next()
    assert bodies_now(bodies) == []
    cluster.log.append((time.time() + 1, b"before"))
    assert bodies_now(bodies) == [b"before"]
    cluster.log[:] = [(time.time() + 60, b"after"), (time.time() + 61, b"killed since")]  # by a node that is gone
    cluster.assign_next()
    assert bodies_now(bodies) == [b"after", b"killed since"]


def test_group_continues_where_it_was(cluster: OnePartition) -> None:
    cluster.log += [(time.time() - 60, b"read"), (time.time() - 50, b"unread")]
    cluster.committed_offset = 1
    cluster.assign_next()
    assert bodies_now(kafka.read(cluster, "t", group="g")) == [b"unread"]  # type: ignore[arg-type]


def test_new_record_of_a_sender_whose_clock_is_slow_is_read(cluster: OnePartition) -> None:
    cluster.log.append((time.time() - 60, b"earlier"))
    bodies = kafka.read(cluster, "t", group="g")  # type: ignore[arg-type]
    cluster.assign_next()
    assert bodies_now(bodies) == []
    cluster.log.append((time.time() - 3600, b"slow"))
    assert bodies_now(bodies) == [b"slow"]


def test_records_since_a_time_are_read_with_those_of_slow_clocks_between_them(cluster: OnePartition) -> None:
    cluster.log += [(100.0, b"earlier"), (200.0, b"since"), (50.0, b"slow"), (201.0, b"last")]
    cluster.assign_next()
    bodies = kafka.read(cluster, "t", group="g", since=150.0)  # type: ignore[arg-type]
    assert bodies_now(bodies) == [b"since", b"slow", b"last"]


def test_real_broker_delivers_what_arrives_before_the_assignment(broker: Broker) -> None:
    producer, assigned = kafka.TopicProducer(broker.cluster, "t"), list[bool]()
    producer.send([OutboxRecord(1, "a:1", b"earlier")])
    time.sleep(0.01)  # times are in milliseconds
    bodies = kafka.read(broker.cluster, "t", group="g", wait=0.1, connected=assigned.append)
    assert next(bodies) is None and True not in assigned
    producer.send([OutboxRecord(2, "a:2", b"new")])
    assert next(body for body in bodies if body) == b"new"
