"""State of the bus as derived from its events: runs, queues and alarms; invalid events are counted."""

from __future__ import annotations

import time
from collections import Counter
from typing import Any

from pydantic import ValidationError

from scan2sim.pipeline.core.errors import printable
from scan2sim.services.monitoring.dashboard.alarms import AlarmStates
from scan2sim.services.monitoring.dashboard.history import MAX_RECORD_BYTES, MAX_WARNING_CHARS, RejectedError
from scan2sim.services.monitoring.dashboard.queues import Queues
from scan2sim.services.monitoring.dashboard.runs import Runs
from scan2sim.services.monitoring.events.schema import KINDS, Alarm, Event, QueueState, RunState, StepState


class BusState:
    """State of runs, queues and alarms, updated by events.

    Attributes:
        runs, queues, alarms: their current states.
        counts: number of rejected events, by reason.
        last_rejected: reason of the last rejection.
    """

    def __init__(self, began: float) -> None:
        """`began`: start of the dashboard, seconds since the epoch; later events count from their arrival."""
        self._began = began
        self.runs, self.queues, self.alarms = Runs(), Queues(), AlarmStates()
        self.counts: Counter[str] = Counter()
        self.last_rejected = ""

    def add(self, body: bytes) -> None:
        """Update the state by an event; invalid events and those beyond a bound are only counted."""
        try:
            event, content = _parse_event(body)
            at = event.time if event.time < self._began else time.time()
            if isinstance(content, (RunState, StepState)):
                self.runs.add(content, at)
            elif isinstance(content, QueueState):
                self.queues.add(content, at)
            elif isinstance(content, Alarm):
                self.alarms.add(content, at)
        except RejectedError as error:
            reason, _, detail = str(error).partition(": ")
            self.counts[reason] += 1
            self.last_rejected = printable(f"{reason}: {detail}"[:MAX_WARNING_CHARS])

    def state(self, now: float) -> dict[str, Any]:
        """JSON-serializable state; `now` in seconds since the epoch."""
        rejected = {"counts": dict(self.counts), "last": self.last_rejected}
        return {
            "runs": self.runs.state(now),
            "queues": self.queues.state(now),
            "alarms": self.alarms.state(),
            "events_rejected": rejected,
        }


def _parse_event(body: bytes) -> tuple[Event, Any]:
    """An event and its parsed body; the body is None for kinds that aren't built in.

    Raises:
        RejectedError: it isn't a valid event.
    """
    if len(body) > MAX_RECORD_BYTES:
        raise RejectedError(f"too large: {len(body)} bytes")
    try:
        event = Event.model_validate_json(body)
        content = KINDS[event.kind].model_validate(event.body) if event.kind in KINDS else None
    except ValidationError as error:
        first = error.errors()[0]
        raise RejectedError(f"invalid event: {'.'.join(map(str, first['loc']))} {first['msg']}") from None
    if not 0 <= event.time < 1e11:
        raise RejectedError(f"invalid event: time {event.time} is out of range")
    return event, content
