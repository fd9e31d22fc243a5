"""Events that wait for workers: in order, within bounds, and none is gone until it is done."""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass

from scan2sim.services.monitoring.events.schema import QueueState
from scan2sim.services.monitoring.settings.monitor import WhenFull

MOST = 100_000
"""Events that wait, at most; what is refused is counted."""
TRIES = 3
"""Workers that may die or hang over an event, before it counts as refused."""


@dataclass
class Waiting:
    """An event that waits or is worked on.

    Attributes:
        line: that its worker reads.
        sent: seconds since the epoch.
        tries: workers that failed at it.
    """

    line: str
    sent: float
    tries: int = 0


class EventQueue:
    """Hands events to workers; may be used from any thread."""

    def __init__(self, name: str, most: int = MOST, when_full: WhenFull = "newest") -> None:
        """Of so many events at most; `when_full` says which one is refused then."""
        self.name, self._most, self._when_full = name, most, when_full
        self._waiting: deque[Waiting] = deque()
        self._in_work: dict[int, Waiting] = {}
        self._changed = threading.Condition()
        self._arrived = self._done = self._refused = 0
        self._oldest_done = 0.0

    def put(self, line: str, sent: float) -> bool:
        """Have an event wait; False: there is no room."""
        with self._changed:
            self._arrived += 1
            if len(self._waiting) >= self._most:
                self._refused += 1
                if self._when_full == "newest":
                    return False
                self._waiting.popleft()
            self._waiting.append(Waiting(line, sent))
            self._changed.notify()
            return True

    def take(self, timeout: float) -> Waiting | None:
        """The one that waits longest, to be worked on; None: none came within so many seconds."""
        with self._changed:
            if not self._waiting:
                self._changed.wait(timeout)
            if not self._waiting:
                return None
            event = self._waiting.popleft()
            self._in_work[id(event)] = event
            return event

    def done(self, event: Waiting) -> None:
        """It is done."""
        with self._changed:
            del self._in_work[id(event)]
            self._done += 1
            self._oldest_done = max(self._oldest_done, time.time() - event.sent)

    def failed(self, event: Waiting) -> None:
        """Its worker died: it is the next one's, unless too many have died over it."""
        with self._changed:
            del self._in_work[id(event)]
            event.tries += 1
            if event.tries >= TRIES:
                self._refused += 1
                return
            self._waiting.appendleft(event)
            self._changed.notify()

    def __len__(self) -> int:
        """Events that wait or are worked on."""
        with self._changed:
            return len(self._waiting) + len(self._in_work)

    def state(self, seconds: float, workers: int) -> QueueState:
        """What became of it in the last so many seconds; counting begins anew."""
        with self._changed:
            sent = min((one.sent for one in (*list(self._waiting)[:1], *self._in_work.values())), default=None)
            state = QueueState(
                queue=self.name,
                seconds=seconds,
                arrived=self._arrived,
                done=self._done,
                refused=self._refused,
                waiting=len(self._waiting) + len(self._in_work),
                oldest=max(0.0, time.time() - sent) if sent is not None else 0.0,
                oldest_done=self._oldest_done,
                workers=workers,
            )
            self._arrived = self._done = self._refused = 0
            self._oldest_done = 0.0
            return state
