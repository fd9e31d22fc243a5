"""What goes through a node: messages, bytes, latencies and losses, counted as they pass and read once a period."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
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
        unreadable: messages that aren't of the topic's type.
    """

    flow: Flow
    sent: int | None
    lost: int | None
    latencies: tuple[int, ...]
    clock: tuple[int, int] | None
    unreadable: int = 0


@dataclass(frozen=True)
class Reading:
    """All that went through a node over a period: by topic, its full name."""

    outgoing: dict[str, Flow]
    incoming: dict[str, Incoming]


@dataclass(slots=True)
class _Numbers:
    """Of one publisher's messages: what was received and what is lost, whatever their order."""

    highest: int
    reported: int
    missing: int = 0
    silent: int = 0

    def count(self, number: int) -> None:
        if number == self.highest + 1:
            self.highest = number
        elif number > self.highest:
            self.missing += number - self.highest - 1
            self.highest = number
        elif self.missing:
            self.missing -= 1  # one that was overtaken

    def period(self) -> tuple[int, int]:
        """Messages sent and lost since the last call."""
        sent, lost = self.highest - self.reported, self.missing
        self.silent = 0 if sent else self.silent + 1
        self.reported, self.missing = self.highest, 0
        return sent, lost


@dataclass(slots=True)
class _Topic:
    """What came on a topic since it was last read.

    Attributes:
        latencies: publishers and nanoseconds, by the two clocks.
    """

    latencies: deque[tuple[bytes | None, int]]
    messages: int = 0
    size: int = 0
    unreadable: int = 0
    unnumbered: bool = False
    last: bytes | None = None
    numbers: dict[bytes, _Numbers] = field(default_factory=dict)


Offset = Callable[[bytes | None], tuple[int, int] | None]
"""A publisher to how far its clock is ahead, as `Incoming.clock`."""


def _unknown(_: bytes | None) -> None:
    return None


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

    def received(self, arrival: Arrival) -> None:
        """Count a message that came."""
        name, size, received, sent, publisher, number = arrival
        with self._lock:
            topic = self._incoming.get(name)
            if topic is None:
                topic = self._incoming[name] = _Topic(deque(maxlen=self._window))
            topic.messages += 1
            topic.size += size
            topic.last = publisher
            if sent is not None:
                topic.latencies.append((publisher, received - sent))
            if publisher is None or number is None:
                topic.unnumbered = True
                return
            numbers = topic.numbers.get(publisher)
            if numbers is None:
                numbers = topic.numbers[publisher] = _Numbers(highest=number - 1, reported=number - 1)
            numbers.count(number)

    def unreadable(self, topic: str) -> None:
        """Count a message that came, and wasn't of its topic's type."""
        with self._lock:
            self._incoming[topic].unreadable += 1

    def publishers(self) -> set[bytes]:
        """Those that messages came from."""
        with self._lock:
            topics = self._incoming.values()
            return {one for topic in topics for one in (topic.last, *topic.numbers) if one is not None}

    def read(self, offset: Offset = _unknown) -> Reading:
        """What was counted since the last reading, of all topics that ever had a message; clocks by `offset`."""
        with self._lock:
            outgoing = {topic: Flow(*counts) for topic, counts in self._outgoing.items()}
            for counts in self._outgoing.values():
                counts[:] = 0, 0
            return Reading(outgoing, {name: _period(topic, offset) for name, topic in self._incoming.items()})


def _period(topic: _Topic, offset: Offset) -> Incoming:
    clocks = {publisher: offset(publisher) for publisher in {topic.last, *(one for one, _ in topic.latencies)}}
    ahead = {publisher: clock[0] if clock else 0 for publisher, clock in clocks.items()}
    latencies = [latency + ahead[publisher] for publisher, latency in topic.latencies]
    counts = [numbers.period() for numbers in topic.numbers.values()]
    numbered = bool(counts) and not topic.unnumbered
    found = Incoming(
        flow=Flow(topic.messages, topic.size),
        sent=sum(sent for sent, _ in counts) if numbered else None,
        lost=sum(lost for _, lost in counts) if numbered else None,
        latencies=tuple(latency for latency in latencies if latency > -LATE),
        clock=clocks[topic.last],
        unreadable=topic.unreadable,
    )
    topic.messages = topic.size = topic.unreadable = 0
    topic.latencies.clear()
    topic.numbers = {gid: numbers for gid, numbers in topic.numbers.items() if numbers.silent < FORGOTTEN}
    return found
