"""What a page shows of the bus's events: runs, queues and alarms; others are left, and what is no event is counted."""

from __future__ import annotations

import time
from collections import Counter
from typing import Any

from pydantic import ValidationError

from scan2sim.pipeline.core.errors import printable
from scan2sim.services.monitoring.dashboard.alarms import Raised
from scan2sim.services.monitoring.dashboard.history import LARGEST, REMARK, Refused
from scan2sim.services.monitoring.dashboard.queues import Queues
from scan2sim.services.monitoring.dashboard.runs import Runs
from scan2sim.services.monitoring.events.schema import KINDS, Alarm, Event, QueueState, RunState, StepState


class Noticed:
    """Takes events as they come.

    Attributes:
        runs, queues, alarms: what they say.
        counts: of events that were refused, by why.
        last_refused: why the last one was.
    """

    def __init__(self, began: float) -> None:
        """Events from before `began`, seconds since the epoch, are from back then; later ones from when they come."""
        self._began = began
        self.runs, self.queues, self.alarms = Runs(), Queues(), Raised()
        self.counts: Counter[str] = Counter()
        self.last_refused = ""

    def take(self, body: bytes) -> None:
        """Notice what an event says; what is none, or has no room, is counted, and nothing else happens."""
        try:
            event, said = _parsed(body)
            at = event.time if event.time < self._began else time.time()
            if isinstance(said, (RunState, StepState)):
                self.runs.take(said, at)
            elif isinstance(said, QueueState):
                self.queues.take(said, at)
            elif isinstance(said, Alarm):
                self.alarms.take(said, at)
        except Refused as refused:
            why, _, detail = str(refused).partition(": ")
            self.counts[why] += 1
            self.last_refused = printable(f"{why}: {detail}"[:REMARK])

    def state(self, now: float) -> dict[str, Any]:
        """All of it, JSON-able; `now` in seconds since the epoch."""
        refused = {"counts": dict(self.counts), "last": self.last_refused}
        return {
            "runs": self.runs.state(now),
            "queues": self.queues.state(now),
            "alarms": self.alarms.state(),
            "events_refused": refused,
        }


def _parsed(body: bytes) -> tuple[Event, Any]:
    """An event, and what it says; None of a kind that isn't the bus's own.

    Raises:
        Refused: it is none.
    """
    if len(body) > LARGEST:
        raise Refused(f"too large: {len(body)} bytes")
    try:
        event = Event.model_validate_json(body)
        said = KINDS[event.kind].model_validate(event.body) if event.kind in KINDS else None
    except ValidationError as error:
        first = error.errors()[0]
        raise Refused(f"no event: {'.'.join(map(str, first['loc']))} {first['msg']}") from None
    if not 0 <= event.time < 1e11:
        raise Refused(f"no event: of the time {event.time}")
    return event, said
