"""Events of the bus: programs define their own kinds of events, send them, and register callbacks for them.

    events = Events("counter")
    events.define("count", Count)                     # a pydantic model: other bodies are rejected by all programs
    events.on("count", lambda count: print(count.vehicles))
    events.send("count", Count(vehicles=3))

On the bus an event is JSON (`Event`), readable from ROS 2 or Kafka in any language (`bus.Bus` connects to both).
`python -m scan2sim.services.monitoring.events.schema` prints its JSON Schema and those of the built-in kinds.
"""

from __future__ import annotations

import json
import logging
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from typing import Annotated, Any, Literal, Protocol

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.services.monitoring.messages import (
    RejectedError,
    Rejections,
    check_record_id,
    first_error,
    load_json,
    validated_record,
)
from scan2sim.services.monitoring.record import SCHEMA
from scan2sim.services.outbox import Deduplicator, new_ids

log = logging.getLogger(__name__)

RECORD = "record"
"""Kind under which monitoring records are delivered: as a dict with the field names of D3.2."""


class Body(BaseModel):
    """Base class of event bodies, also for the kinds of other programs."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Alarm(Body):
    """A rule's alarm was raised or cleared, or a raised one was acknowledged or muted.

    Attributes:
        rule: name of the rule.
        subject: topic, node, queue, or "topic at node".
        value: current value of the rule's metric.
        since: when the condition started to hold, seconds since the epoch.
        acknowledged_by: name of the person that has acknowledged it; "" if nobody has.
        muted_until: until when nobody is notified of it, seconds since the epoch.
    """

    state: Literal["raised", "cleared"]
    rule: str
    subject: str
    value: float
    since: float
    acknowledged_by: str = ""
    muted_until: float = 0.0


class AlarmCommand(Body):
    """A person's command to the alarm node.

    Attributes:
        action: "acknowledge" a raised alarm; "mute" alarms until a time; "retire" a node, whose alarms end.
        rule: name of the rule; patterns like "*" are allowed, as in `subject`.
        subject: of the alarm; to retire, the full name of a node.
        by: name of the person that gives the command.
        until: end of muting, seconds since the epoch; 0 ends it now.
    """

    action: Literal["acknowledge", "mute", "retire"]
    rule: Annotated[str, Field(max_length=100)] = "*"
    subject: Annotated[str, Field(min_length=1, max_length=1000)]
    by: Annotated[str, Field(max_length=100)] = ""
    until: Annotated[float, Field(ge=0, le=1e11)] = 0.0


class QueueState(Body):
    """Statistics of a queue of events over a period.

    Attributes:
        queue: name of the queue.
        seconds: length of the period.
        arrived, done, rejected: number of events that arrived, were processed, and were rejected in the period.
        waiting: events that wait or are being processed.
        oldest: age of the oldest waiting event, seconds since it was sent; 0 without any.
        oldest_done: largest age of an event at the time it was done in the period, seconds.
        workers: running workers.
    """

    queue: str
    seconds: float
    arrived: int
    done: int
    rejected: int
    waiting: int
    oldest: float
    oldest_done: float
    workers: int


class WorkersWanted(Body):
    """Autoscaler's request: number of workers for a queue, with its rate (events per second) and waiting events."""

    queue: str
    workers: int
    rate: float
    waiting: int


Name = Annotated[str, Field(max_length=256)]
Text = Annotated[str, Field(max_length=400)]
Count = Annotated[int, Field(ge=0)]


class RunState(Body):
    """Progress of a run (`scan2sim run`, a survey): published when its tasks change state, and every five seconds.

    Attributes:
        run: unique id.
        command: command that runs, such as "survey".
        source: its input as given by the user: a tile, a survey, a drive.
        host: machine on which the command was started.
        state: "stopped" if the user stopped it.
        steps: number of tasks known so far; of these `running`, `done`, `cached` and `failed`.
        seconds: elapsed time.
        message: cause of a failure.
    """

    run: Name
    command: Name
    source: Name
    host: Name
    state: Literal["running", "done", "failed", "stopped"]
    steps: Count
    running: Count
    done: Count
    cached: Count
    failed: Count
    seconds: Annotated[float, Field(ge=0)]
    message: Text = ""


class StepState(Body):
    """Progress of a task of a run: published at most once per second on progress, else every few seconds.

    Attributes:
        run: id of its run.
        tile: tile of a survey; "" for a run on a single tile.
        step: its name within the tile, such as "poisson.terrain".
        progress: completed fraction, 0 to 1.
        seconds: run time so far, or in total; None: it hasn't run.
        memory: peak memory of its processes, bytes; None: unknown while it runs.
        message: what it is working on, or the cause of a failure.
        host: machine on which it runs; None: unknown to the publisher.
    """

    run: Name
    tile: Name
    step: Name
    state: Literal["waiting", "running", "done", "cached", "failed"]
    progress: Annotated[float, Field(ge=0, le=1)] = 0.0
    seconds: Annotated[float, Field(ge=0)] | None = None
    memory: Count | None = None
    message: Text = ""
    host: Name | None = None


class Event(BaseModel):
    """An event on the bus.

    Attributes:
        id: unique id; two events with the same id are duplicates.
        time: when it was sent, seconds since the epoch.
        sender: name of the sending program.
        kind: determines the schema of the body.
    """

    model_config = ConfigDict(frozen=True, populate_by_name=True)

    schema_name: Literal["scan2sim-event-1"] = Field("scan2sim-event-1", alias="schema")
    """Schema identifier; changes whenever a field does."""
    id: str = Field(alias="record id")
    time: float
    sender: str
    kind: str
    body: dict[str, Any]

    @property
    def category(self) -> str:
        """Category in an outbox (`outbox.Outbox`): its kind, so that a flood of one kind doesn't displace alarms."""
        return self.kind

    def json_line(self) -> str:
        """Serialize as one line of JSON."""
        return self.model_dump_json(by_alias=True)


class Outlet(Protocol):
    """Publishes events to other programs."""

    def send(self, event: Event, /) -> None:
        """Accept an event without blocking."""

    def close(self) -> None:
        """Release all resources."""


Callback = Callable[[Any], None]
KINDS: dict[str, type[BaseModel]] = {
    "alarm": Alarm,
    "alarm_command": AlarmCommand,
    "queue": QueueState,
    "workers": WorkersWanted,
    "run": RunState,
    "step": StepState,
}
"""Built-in kinds."""


class Events:
    """Sends events and calls the callbacks registered for them; thread-safe, callbacks are called one at a time.

    Attributes:
        deduplicator: of what is received.
        rejections: received messages that were not valid events, by reason.
    """

    def __init__(self, sender: str) -> None:
        self._sender, self._next_id, self.deduplicator = sender, new_ids(), Deduplicator()
        self._kinds, self._callbacks = dict(KINDS), defaultdict[str, list[Callback]](list)
        self._lock = threading.RLock()
        self.outlets: list[Outlet] = []
        self.rejections = Rejections(f"the event bus of {sender}")

    def define(self, kind: str, schema: type[BaseModel]) -> None:
        """Define the body of a kind of events.

        Raises:
            SettingError: the kind is already defined with another body.
        """
        if self._kinds.setdefault(kind, schema) is not schema or kind == RECORD:
            raise SettingError(kind, "this kind of event is already defined", "Choose another name")

    def on(self, kind: str, callback: Callback) -> None:
        """Register `callback(body)` for every event of a kind, own ones included; `RECORD`: monitoring records."""
        if kind != RECORD:
            self._schema(kind)
        self._callbacks[kind].append(callback)

    def send(self, kind: str, body: BaseModel) -> Event:
        """Send an event and call the callbacks registered for it in this program.

        Raises:
            SettingError: the kind isn't defined, or the body has another type.
        """
        if not isinstance(body, self._schema(kind)):
            cause = f"events of this kind have no body of type {type(body).__name__}"
            raise SettingError(kind, cause, f"Send a {self._kinds[kind].__name__}")
        event = Event(
            id=self._next_id(), time=time.time(), sender=self._sender, kind=kind, body=body.model_dump(mode="json")
        )
        for outlet in self.outlets:
            outlet.send(event)
        with self._lock:
            self.deduplicator.is_new(event.id)
            self._dispatch(kind, body)
        return event

    def receive(self, line: str | bytes) -> None:
        """Call the callbacks for a message from the bus; duplicates and undefined kinds are ignored."""
        try:
            fields = load_json(line)
            kind: str
            body: Any
            if isinstance(fields, dict) and fields.get("schema") == SCHEMA:
                kind, body, record_id = RECORD, fields, validated_record(fields).id
            else:
                event = Event.model_validate(fields)
                check_record_id(event.id)
                if event.kind not in self._kinds:
                    return
                kind, record_id, body = event.kind, event.id, self._kinds[event.kind].model_validate(event.body)
            with self._lock:
                if self.deduplicator.is_new(record_id):
                    self._dispatch(kind, body)
        except ValidationError as error:
            self.rejections.add(f"invalid event: {first_error(error)}")
        except RejectedError as error:
            self.rejections.add(error)

    def _schema(self, kind: str) -> type[BaseModel]:
        if kind not in self._kinds:
            raise SettingError(kind, "unknown kind of event", "Define it with Events.define(kind, schema)")
        return self._kinds[kind]

    def _dispatch(self, kind: str, body: Any) -> None:
        for callback in self._callbacks[kind]:
            try:
                callback(body)
            except Exception:  # the other callbacks must still be called
                log.exception("a callback for events of kind %r failed", kind)


if __name__ == "__main__":
    schemas: dict[str, type[BaseModel]] = {"event": Event, **KINDS}
    print(json.dumps({name: schema.model_json_schema(by_alias=True) for name, schema in schemas.items()}, indent=2))
