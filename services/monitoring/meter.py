"""What goes through a node: messages, bytes, latencies and losses, counted as they pass and read once a period."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass, field

from scan2sim.services.transport.types import Arrival

LATE = 1_000_000_000
"""Nanoseconds that a message may have been sent after it came, by clocks that differ; more is no clock to go by."""
FORGOTTEN = 1000
"""Periods without a message after which a publisher is forgotten."""


@dataclass(frozen=True)
class Flow:
    """Messages of one direction over a period.

    Attributes:
        messages: their number.
        size: bytes of all.
    """

    messages: int = 0
    size: int = 0

    def mean(self) -> float:
        """Bytes of a message."""
        return self.size / self.messages if self.messages else 0.0


@dataclass(frozen=True)
class Incoming:
    """What came on one topic over a period.

    Attributes:
        flow: what was received.
        sent: messages that their publishers numbered meanwhile; None: they number none.
        lost: of these, what didn't come; None likewise.
        latencies: nanoseconds, of the last ones (as many as the window holds), with clocks' offsets taken away.
        clock: nanoseconds by which the last sender's clock is ahead, and how far that may be off; None: unknown.
    """

    flow: Flow
    sent: int | None
    lost: int | None
    latencies: tuple[int, ...]
    clock: tuple[int, int] | None


@dataclass(frozen=True)
class Reading:
    """All that went through a node over a period: by topic, its full name."""

    outgoing: dict[str, Flow]
    incoming: dict[str, Incoming]


@dataclass
class _Numbers:
    """Of one publisher's messages: what was received and what is lost, whatever their order."""

    highest: int
    reported: int
    missing: int = 0
    silent: int = 0

    def count(self, number: int) -> None:
        if number > self.highest:
            self.missing += number - self.highest - 1
            self.highest = number
        elif self.missing:
            self.missing -= 1  # one that was overtaken

    def period(self) -> tuple[int, int]:
        """Messages sent and lost since it was last asked."""
        told = self.highest - self.reported, self.missing
        self.silent = 0 if told[0] else self.silent + 1
        self.reported, self.missing = self.highest, 0
        return told


@dataclass
class _Topic:
    latencies: deque[int]
    messages: int = 0
    size: int = 0
    unnumbered: bool = False
    clock: tuple[int, int] | None = None
    numbers: dict[bytes, _Numbers] = field(default_factory=dict)


class Meter:
    """Counts; may be used from any thread."""

    def __init__(self, window: int) -> None:
        """Keep latencies of the last `window` messages of each topic."""
        self._window = window
        self._lock = threading.Lock()
        self._outgoing: dict[str, list[int]] = {}
        self._incoming: dict[str, _Topic] = {}

    def published(self, topic: str, size: int) -> None:
        """Count a message that was sent."""
        with self._lock:
            flow = self._outgoing.setdefault(topic, [0, 0])
            flow[0] += 1
            flow[1] += size

    def received(self, arrival: Arrival, clock: tuple[int, int] | None = None) -> None:
        """Count a message that came; `clock` as `Incoming`'s."""
        with self._lock:
            topic = self._incoming.get(arrival.topic)
            if topic is None:
                topic = self._incoming[arrival.topic] = _Topic(deque(maxlen=self._window))
            topic.messages += 1
            topic.size += arrival.size
            topic.clock = clock
            if arrival.sent is not None:
                latency = arrival.received - arrival.sent + (clock[0] if clock else 0)
                if latency > -LATE:
                    topic.latencies.append(latency)
            if arrival.publisher is None or arrival.number is None:
                topic.unnumbered = True
                return
            numbers = topic.numbers.get(arrival.publisher)
            if numbers is None:
                before = arrival.number - 1
                numbers = topic.numbers[arrival.publisher] = _Numbers(highest=before, reported=before)
            numbers.count(arrival.number)

    def read(self) -> Reading:
        """What was counted since the last reading, of all topics that ever had a message."""
        with self._lock:
            outgoing = {topic: Flow(*counts) for topic, counts in self._outgoing.items()}
            for counts in self._outgoing.values():
                counts[:] = 0, 0
            return Reading(outgoing, {name: _period(topic) for name, topic in self._incoming.items()})


def _period(topic: _Topic) -> Incoming:
    told = [numbers.period() for numbers in topic.numbers.values()]
    numbered = bool(told) and not topic.unnumbered
    found = Incoming(
        flow=Flow(topic.messages, topic.size),
        sent=sum(sent for sent, _ in told) if numbered else None,
        lost=sum(lost for _, lost in told) if numbered else None,
        latencies=tuple(topic.latencies),
        clock=topic.clock,
    )
    topic.messages = topic.size = 0
    topic.latencies.clear()
    topic.numbers = {gid: numbers for gid, numbers in topic.numbers.items() if numbers.silent < FORGOTTEN}
    return found
