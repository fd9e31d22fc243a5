"""State of the bus as derived from its events: runs, queues, alarms, retired nodes; invalid events are counted."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from pydantic import ValidationError

from scan2sim.services.monitoring.dashboard.alarms import AlarmStates
from scan2sim.services.monitoring.dashboard.queues import Queues
from scan2sim.services.monitoring.dashboard.runs import Runs
from scan2sim.services.monitoring.events.schema import (
    KINDS,
    Alarm,
    AlarmCommand,
    Event,
    QueueState,
    RunState,
    StepState,
)
from scan2sim.services.monitoring.messages import MAX_TIME_S, RejectedError, Rejections, first_error, load_json


class BusState:
    """State of runs, queues and alarms, updated by events.

    Attributes:
        runs, queues, alarms: their current states.
        rejections: rejected events by reason.
    """

    def __init__(self, began: float, retire: Callable[[str, float], None] = lambda node, at: None) -> None:
        """Create it empty.

        Args:
            began: start of the dashboard, seconds since the epoch; later events count from their arrival.
            retire: called with the full name of each node that is retired, and when.
        """
        self._began, self._retire = began, retire
        self.runs, self.queues, self.alarms = Runs(), Queues(), AlarmStates()
        self.rejections = Rejections("events")

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
            elif isinstance(content, AlarmCommand) and content.action == "retire":
                self._retire(content.subject, at)
        except RejectedError as error:
            self.rejections.add(error)

    def state(self, now: float) -> dict[str, Any]:
        """JSON-serializable state; `now` in seconds since the epoch."""
        rejected = {"counts": dict(self.rejections.counts), "last": self.rejections.last}
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
    fields = load_json(body)
    try:
        event = Event.model_validate(fields)
        content = KINDS[event.kind].model_validate(event.body) if event.kind in KINDS else None
    except ValidationError as error:
        raise RejectedError(f"invalid event: {first_error(error)}") from None
    if not 0 <= event.time < MAX_TIME_S:
        raise RejectedError(f"invalid event: time {event.time} is out of range")
    return event, content
