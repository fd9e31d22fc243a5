"""Bounded, ordered event queue for workers; an event stays in the queue until it is done."""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass

from scan2sim.services.monitoring.events.schema import QueueState
from scan2sim.services.monitoring.settings.monitor import WhenFull

MAX_WAITING = 100_000
"""Default capacity; dropped events are counted as rejected."""
MAX_ATTEMPTS = 3
"""An event at which this many workers died or hung is dropped and counted as rejected."""


@dataclass
class QueuedEvent:
    """An event that waits or is being processed.

    Attributes:
        line: input line for its worker.
        sent: when it was sent, seconds since the epoch.
        attempts: number of workers that failed at it.
    """

    line: str
    sent: float
    attempts: int = 0


class EventQueue:
    """Distributes events to workers; thread-safe."""

    def __init__(self, name: str, capacity: int = MAX_WAITING, when_full: WhenFull = "newest") -> None:
        """`capacity`: maximum of waiting events; `when_full`: which event is dropped beyond it."""
        self.name, self._capacity, self._when_full = name, capacity, when_full
        self._waiting: deque[QueuedEvent] = deque()
        self._in_work: dict[int, QueuedEvent] = {}
        self._changed = threading.Condition()
        self._arrived = self._done = self._rejected = 0
        self._oldest_done = 0.0

    def put(self, line: str, sent: float) -> bool:
        """Append an event; False if the queue is full and the event was dropped."""
        with self._changed:
            self._arrived += 1
            if len(self._waiting) >= self._capacity:
                self._rejected += 1
                if self._when_full == "newest":
                    return False
                self._waiting.popleft()
            self._waiting.append(QueuedEvent(line, sent))
            self._changed.notify()
            return True

    def take(self, timeout: float) -> QueuedEvent | None:
        """Take the oldest waiting event for processing; None if none arrives within `timeout` seconds."""
        with self._changed:
            if not self._waiting:
                self._changed.wait(timeout)
            if not self._waiting:
                return None
            event = self._waiting.popleft()
            self._in_work[id(event)] = event
            return event

    def done(self, event: QueuedEvent) -> None:
        """Mark an event as done and remove it."""
        with self._changed:
            del self._in_work[id(event)]
            self._done += 1
            self._oldest_done = max(self._oldest_done, time.time() - event.sent)

    def failed(self, event: QueuedEvent) -> None:
        """Requeue an event whose worker died, or drop it after `MAX_ATTEMPTS`."""
        with self._changed:
            del self._in_work[id(event)]
            event.attempts += 1
            if event.attempts >= MAX_ATTEMPTS:
                self._rejected += 1
                return
            self._waiting.appendleft(event)
            self._changed.notify()

    def __len__(self) -> int:
        """Number of events that wait or are being processed."""
        with self._changed:
            return len(self._waiting) + len(self._in_work)

    def state(self, seconds: float, workers: int) -> QueueState:
        """Statistics of the last `seconds`; the counters restart at zero."""
        with self._changed:
            sent = min((one.sent for one in (*list(self._waiting)[:1], *self._in_work.values())), default=None)
            state = QueueState(
                queue=self.name,
                seconds=seconds,
                arrived=self._arrived,
                done=self._done,
                rejected=self._rejected,
                waiting=len(self._waiting) + len(self._in_work),
                oldest=max(0.0, time.time() - sent) if sent is not None else 0.0,
                oldest_done=self._oldest_done,
                workers=workers,
            )
            self._arrived = self._done = self._rejected = 0
            self._oldest_done = 0.0
            return state
