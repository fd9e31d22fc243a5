"""Traffic meter of a node: counts messages, bytes, latencies and losses; read once per period."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from scan2sim.services.transport.types import Arrival

MAX_NEGATIVE_LATENCY_NS = 1_000_000_000
"""Latencies below minus this value are discarded: clocks differ a little, larger differences are wrong timestamps."""
PUBLISHER_EXPIRY_PERIODS = 1000
"""Periods without a message after which the sequence counter of a publisher is deleted."""


@dataclass(frozen=True)
class Flow:
    """Messages in one direction over a period.

    Attributes:
        messages: number of messages.
        size: their total size, bytes.
    """

    messages: int = 0
    size: int = 0

    def mean(self) -> float:
        """Mean size of a message, bytes."""
        return self.size / self.messages if self.messages else 0.0


@dataclass(frozen=True)
class Incoming:
    """Messages received on one topic over a period.

    Attributes:
        flow: received messages and bytes.
        sent: messages published in the period according to their sequence numbers; None: publishers don't number them.
        lost: number of these that weren't received; None likewise.
        latencies: nanoseconds, of the latest messages (the size of the window), corrected for the clock offsets.
        clock: offset of the latest sender's clock and its uncertainty, nanoseconds; positive: ahead; None: unknown.
        unreadable: messages that could not be deserialized as the topic's type.
    """

    flow: Flow
    sent: int | None
    lost: int | None
    latencies: tuple[int, ...]
    clock: tuple[int, int] | None
    unreadable: int = 0


@dataclass(frozen=True)
class Reading:
    """Traffic of a node over a period, by full topic name."""

    outgoing: dict[str, Flow]
    incoming: dict[str, Incoming]


@dataclass(slots=True)
class _SequenceCounter:
    """Sequence numbers of one publisher: counts sent and lost messages, whatever their order of arrival."""

    highest: int
    reported: int
    missing: int = 0
    silent_periods: int = 0

    def count(self, number: int) -> None:
        if number == self.highest + 1:
            self.highest = number
        elif number > self.highest:
            self.missing += number - self.highest - 1
            self.highest = number
        elif self.missing:
            self.missing -= 1  # arrived out of order

    def end_period(self) -> tuple[int, int]:
        """Messages sent and lost since the last call."""
        sent, lost = self.highest - self.reported, self.missing
        self.silent_periods = 0 if sent else self.silent_periods + 1
        self.reported, self.missing = self.highest, 0
        return sent, lost


@dataclass(slots=True)
class _TopicCounter:
    """Messages received on a topic since the last reading.

    Attributes:
        latencies: (publisher, nanoseconds) by the two machines' clocks, uncorrected.
    """

    latencies: deque[tuple[bytes | None, int]]
    messages: int = 0
    size: int = 0
    unreadable: int = 0
    unnumbered: bool = False
    last: bytes | None = None
    sequences: dict[bytes, _SequenceCounter] = field(default_factory=dict)


ClockOffset = Callable[[bytes | None], tuple[int, int] | None]
"""Function from a publisher's GID to its clock offset and uncertainty, as `Incoming.clock`."""


def _unknown_offset(_: bytes | None) -> None:
    return None


class Meter:
    """Counts the messages of a node; thread-safe."""

    def __init__(self, window: int) -> None:
        """`window`: number of latest messages of each topic whose latencies are kept."""
        self._window = window
        self._lock = threading.Lock()
        self._outgoing: dict[str, list[int]] = {}
        self._incoming: dict[str, _TopicCounter] = {}

    def published(self, topic: str, size: int) -> None:
        """Count a published message of `size` bytes."""
        with self._lock:
            flow = self._outgoing.setdefault(topic, [0, 0])
            flow[0] += 1
            flow[1] += size

    def received(self, arrival: Arrival) -> None:
        """Count a received message."""
        name, size, received, sent, publisher, number = arrival
        with self._lock:
            topic = self._incoming.get(name)
            if topic is None:
                topic = self._incoming[name] = _TopicCounter(deque(maxlen=self._window))
            topic.messages += 1
            topic.size += size
            topic.last = publisher
            if sent is not None:
                topic.latencies.append((publisher, received - sent))
            if publisher is None or number is None:
                topic.unnumbered = True
                return
            sequence = topic.sequences.get(publisher)
            if sequence is None:
                sequence = topic.sequences[publisher] = _SequenceCounter(highest=number - 1, reported=number - 1)
            sequence.count(number)

    def unreadable(self, topic: str) -> None:
        """Count a received message that could not be deserialized as its topic's type."""
        with self._lock:
            self._incoming[topic].unreadable += 1

    def publishers(self) -> set[bytes]:
        """GIDs of the publishers whose messages were received."""
        with self._lock:
            topics = self._incoming.values()
            return {one for topic in topics for one in (topic.last, *topic.sequences) if one is not None}

    def read(self, offset: ClockOffset = _unknown_offset) -> Reading:
        """Counts since the last reading, for all topics that ever had a message; then the counters restart at zero."""
        with self._lock:
            outgoing = {topic: Flow(*counts) for topic, counts in self._outgoing.items()}
            for counts in self._outgoing.values():
                counts[:] = 0, 0
            return Reading(outgoing, {name: _end_period(topic, offset) for name, topic in self._incoming.items()})


def _end_period(topic: _TopicCounter, offset: ClockOffset) -> Incoming:
    clocks = {publisher: offset(publisher) for publisher in {topic.last, *(one for one, _ in topic.latencies)}}
    ahead = {publisher: clock[0] if clock else 0 for publisher, clock in clocks.items()}
    latencies = [latency + ahead[publisher] for publisher, latency in topic.latencies]
    counts = [sequence.end_period() for sequence in topic.sequences.values()]
    numbered = bool(counts) and not topic.unnumbered
    found = Incoming(
        flow=Flow(topic.messages, topic.size),
        sent=sum(sent for sent, _ in counts) if numbered else None,
        lost=sum(lost for _, lost in counts) if numbered else None,
        latencies=tuple(latency for latency in latencies if latency > -MAX_NEGATIVE_LATENCY_NS),
        clock=clocks[topic.last],
        unreadable=topic.unreadable,
    )
    topic.messages = topic.size = topic.unreadable = 0
    topic.latencies.clear()
    topic.sequences = {
        gid: sequence for gid, sequence in topic.sequences.items() if sequence.silent_periods < PUBLISHER_EXPIRY_PERIODS
    }
    return found
