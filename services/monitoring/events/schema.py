"""Events of the bus: programs define kinds of messages of their own, send them, and attach actions to them.

    events = Events("counter")
    events.define("count", Count)                     # a pydantic model: what isn't so is refused, here and elsewhere
    events.on("count", lambda count: print(count.vehicles))
    events.send("count", Count(vehicles=3))

On the bus an event is JSON (`Event`), which programs in any language read from ROS 2 or Kafka (`bus.Bus` joins both);
`python -m scan2sim.services.monitoring.events.schema` prints its JSON Schema, and those of the bus's own kinds.
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
from scan2sim.services.monitoring.node import record
from scan2sim.services.outbox import Once, new_ids

log = logging.getLogger(__name__)

RECORD = "record"
"""The kind under which monitors' records come: as they are, a dict by D3.2's names."""


class Body(BaseModel):
    """What an event says; of other programs' kinds, too."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Alarm(Body):
    """A rule is broken, or kept again.

    Attributes:
        rule: its name.
        subject: what it is about: a topic, a node, or both.
        value: of the rule's metric, now.
        since: seconds since the epoch, from when on it was so.
    """

    state: Literal["raised", "cleared"]
    rule: str
    subject: str
    value: float
    since: float


class QueueState(Body):
    """What became of a queue of events over a period.

    Attributes:
        queue: its name.
        seconds: of the period.
        arrived, done, refused: events that came, were done, and had no room, meanwhile.
        waiting: events that wait or are worked on.
        oldest: seconds since the longest waiting one was sent; 0 of none.
        oldest_done: likewise, when it was done, the oldest of those done meanwhile.
        workers: that run.
    """

    queue: str
    seconds: float
    arrived: int
    done: int
    refused: int
    waiting: int
    oldest: float
    oldest_done: float
    workers: int


class WorkersWanted(Body):
    """So many workers are to run for a queue, as its rate (events a second) and what waits ask for."""

    queue: str
    workers: int
    rate: float
    waiting: int


Name = Annotated[str, Field(max_length=256)]
Text = Annotated[str, Field(max_length=400)]
Count = Annotated[int, Field(ge=0)]


class RunState(Body):
    """How a run of steps fares (`scan2sim run`, a survey): published as steps change, and every five seconds.

    Attributes:
        run: its id, unlike any other's.
        command: what runs, as "survey".
        source: what of, as it was named: a tile, a survey, a drive.
        host: the machine that it is run from.
        state: "stopped" by its user.
        steps: that it has, as far as they are known; of these `running`, `done`, `kept` from before, and `failed`.
        seconds: since it began.
        message: why it failed.
    """

    run: Name
    command: Name
    source: Name
    host: Name
    state: Literal["running", "done", "failed", "stopped"]
    steps: Count
    running: Count
    done: Count
    kept: Count
    failed: Count
    seconds: Annotated[float, Field(ge=0)]
    message: Text = ""


class StepState(Body):
    """How a step of a run fares: told once a second at most where it has come further, else every few seconds.

    Attributes:
        run: id of its run.
        tile: of a survey; "" where one tile is made for itself.
        step: its name within the tile, as "poisson.terrain".
        progress: share that is done, 0 to 1.
        seconds: that it has run, or took; None: it hasn't run.
        memory: peak of its processes, bytes; None: not known, as long as it runs.
        message: what it is at, or why it failed.
        host: the machine that it runs on; None: who tells doesn't know.
    """

    run: Name
    tile: Name
    step: Name
    state: Literal["waiting", "running", "done", "kept", "failed"]
    progress: Annotated[float, Field(ge=0, le=1)] = 0.0
    seconds: Annotated[float, Field(ge=0)] | None = None
    memory: Count | None = None
    message: Text = ""
    host: Name | None = None


class Event(BaseModel):
    """An event on the bus.

    Attributes:
        id: unlike any other's: twice the same is the same event.
        time: seconds since the epoch, when it was sent.
        sender: a program's name.
        kind: which schema its body has.
    """

    model_config = ConfigDict(frozen=True, populate_by_name=True)

    schema_name: Literal["scan2sim-event-1"] = Field("scan2sim-event-1", alias="schema")
    """Changes when a field does."""
    id: str = Field(alias="record id")
    time: float
    sender: str
    kind: str
    body: dict[str, Any]

    @property
    def share(self) -> str:
        """What it counts for in a spool, where room is short: a flood of one kind doesn't crowd out alarms."""
        return self.kind

    def json_line(self) -> str:
        """As one line of JSON."""
        return self.model_dump_json(by_alias=True)


class Outlet(Protocol):
    """Takes events to others."""

    def send(self, event: Event, /) -> None:
        """Take one, at once."""

    def close(self) -> None:
        """Take no more."""


Action = Callable[[Any], None]
KINDS: dict[str, type[BaseModel]] = {
    "alarm": Alarm,
    "queue": QueueState,
    "workers": WorkersWanted,
    "run": RunState,
    "step": StepState,
}
"""Those of the bus itself."""


class Events:
    """Sends events, and does what is attached to them; may be used from any thread, actions are called one by one.

    Attributes:
        malformed: messages that came, and are no events.
    """

    def __init__(self, sender: str) -> None:
        self._sender, self._next_id, self._once = sender, new_ids(), Once()
        self._kinds, self._actions = dict(KINDS), defaultdict[str, list[Action]](list)
        self._lock = threading.RLock()
        self.outlets: list[Outlet] = []
        self.malformed = 0

    def define(self, kind: str, schema: type[BaseModel]) -> None:
        """Say what the body of a kind of events is.

        Raises:
            SettingError: that kind is another already.
        """
        if self._kinds.setdefault(kind, schema) is not schema or kind == RECORD:
            raise SettingError(kind, "is a kind of events already", "Choose another name")

    def on(self, kind: str, action: Action) -> None:
        """Have `action(body)` called with every event of a kind, own ones too; of `RECORD` with monitors' records."""
        if kind != RECORD:
            self._known(kind)
        self._actions[kind].append(action)

    def send(self, kind: str, body: BaseModel) -> Event:
        """Send an event, and do what is attached to it here.

        Raises:
            SettingError: the kind isn't defined, or the body isn't of its schema.
        """
        if not isinstance(body, self._known(kind)):
            raise SettingError(kind, f"is no {type(body).__name__}", f"Send a {self._kinds[kind].__name__}")
        event = Event(
            id=self._next_id(), time=time.time(), sender=self._sender, kind=kind, body=body.model_dump(mode="json")
        )
        for outlet in self.outlets:
            outlet.send(event)
        with self._lock:
            self._once.new(event.id)
            self._act(kind, body)
        return event

    def take(self, line: str | bytes) -> None:
        """Do what is attached to what came over the bus; twice the same is done once, what none defined is left."""
        try:
            fields = json.loads(line)
            if fields.get("schema") == record.SCHEMA:
                kind, body, record_id = RECORD, fields, fields["record id"]
            else:
                event = Event.model_validate(fields)
                if event.kind not in self._kinds:
                    return
                kind, record_id, body = event.kind, event.id, self._kinds[event.kind].model_validate(event.body)
            with self._lock:
                if self._once.new(record_id):
                    self._act(kind, body)
        except (ValueError, KeyError, AttributeError, TypeError, RecursionError) as error:  # pydantic's, too
            self.malformed += 1
            if str(self.malformed).strip("0") == "1":  # the 1st, 10th, 100th, ...: a flood of them fills no log
                cause = error.errors()[0]["msg"] if isinstance(error, ValidationError) else error
                log.warning("message %d that is no event was left: %s (%.100r)", self.malformed, cause, line)

    def _known(self, kind: str) -> type[BaseModel]:
        if kind not in self._kinds:
            raise SettingError(kind, "there is no such kind of events", "Define it, as Events.define(kind, schema)")
        return self._kinds[kind]

    def _act(self, kind: str, body: Any) -> None:
        for action in self._actions[kind]:
            try:
                action(body)
            except Exception:  # one program's action keeps no other from its own
                log.exception("an action on %r failed", kind)


if __name__ == "__main__":
    schemas: dict[str, type[BaseModel]] = {"event": Event, **KINDS}
    print(json.dumps({name: schema.model_json_schema(by_alias=True) for name, schema in schemas.items()}, indent=2))
