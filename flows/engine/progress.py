"""Publishes on the event bus how the steps of a run fare; no run waits for that, or fails because of it.

`watch` only notes what it is told. A thread of the publisher's own opens the ways onto the bus, looks once a second for
what has changed, and sends that; what a broker doesn't take waits on disk (`services.outbox`).
"""

from __future__ import annotations

import logging
import platform
import threading
import time
import uuid
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from scan2sim.flows.engine.planning import Planned
from scan2sim.flows.engine.ready_queue import Event, Watch, unwatched
from scan2sim.flows.pipelines.graph import Node, NodeId
from scan2sim.pipeline.core.cache import Store, read_manifest
from scan2sim.pipeline.core.errors import DamagedError, IncompleteError, ScanError, printable
from scan2sim.services.monitoring.events.schema import Events, Outlet, RunState, StepState
from scan2sim.services.monitoring.export import event_publishers

log = logging.getLogger(__name__)

EVERY = 1.0
"""Seconds between two looks at what has changed."""
AGAIN = 5.0
"""Seconds after which the run, and what runs, is told again though nothing has changed: it lives."""
CLOSING = 2.0
"""Seconds that a run's end waits for its last events to be sent, at most."""
LONGEST, LONGEST_NAME = 400, 256
"""Characters of a message, of a name."""

State = Literal["waiting", "running", "done", "kept", "failed"]
STATES: dict[Event, State] = {
    "start": "running",
    "progress": "running",
    "done": "done",
    "kept": "kept",
    "failed": "failed",
    "again": "waiting",
}


@dataclass(frozen=True)
class Channel:
    """Where the steps of a run are told of, for workers elsewhere that run them.

    Attributes:
        where: as `--bus` has it (`services.monitoring.export.event_publishers`).
        run: the run's id.
    """

    where: str
    run: str


@dataclass
class _Step:
    """What is known of a step; times as `time.monotonic`."""

    item: Planned
    manifest: Path
    state: State = "waiting"
    progress: float = 0.0
    message: str = ""
    began: float = 0.0
    ended: float | None = None
    told: float | None = None
    """None: what is known hasn't been told."""


class Publisher:
    """Publishes the states of the steps of one run."""

    def __init__(
        self,
        run: str,
        opened: Callable[[], Sequence[Outlet]],
        about: Callable[[Counter[State]], RunState] | None = None,
        host: str | None = None,
    ) -> None:
        """Begin.

        Args:
            run: its id.
            opened: opens the ways onto the bus.
            about: how the run itself fares, of its steps by their states; None: another tells that.
            host: the machine that steps run on, where it is known.
        """
        self._run, self._opened, self._about, self._host = run, opened, about, host
        self._steps: dict[NodeId, _Step] = {}
        self._lock, self._ended = threading.Lock(), threading.Event()
        self._told = -AGAIN
        self._thread = threading.Thread(target=self._tell, name="publisher", daemon=True)
        self._thread.start()

    def watching(self, planned: Sequence[Planned], store: Store) -> Watch:
        """Expect these steps; the watch that is to be told of them."""
        with self._lock:
            for item in planned:
                manifest = store.folder(item.node.full_name, item.key) / "manifest.json"
                self._steps.setdefault(item.node.id, _Step(item, manifest)).manifest = manifest
        return self.watch

    def watch(self, node: Node, event: Event, fraction: float, message: str) -> None:
        """An `execution.Watch`: notes what it is told."""
        now = time.monotonic()
        with self._lock:
            step = self._steps[node.id]
            if event == "kept" and step.state == "done":
                return  # by an earlier round of this run
            if event == "start":
                step.began, step.ended = now, None
            step.state, step.progress, step.message, step.told = STATES[event], fraction, message, None
            if step.state not in ("waiting", "running"):
                step.ended = now

    def close(self, timeout: float = CLOSING) -> None:
        """Tell what is left; after so many seconds that goes on by itself, as long as the process lives."""
        self._ended.set()
        self._thread.join(timeout)

    def _tell(self) -> None:
        try:
            events, found = Events("scan2sim"), self._opened()
            events.outlets.extend(found)
            ended = False
            while not ended:
                ended = self._ended.wait(EVERY)
                changed, now = self._changed(), time.monotonic()
                for step in changed:
                    events.send("step", self._state_of(step))
                if self._about and (ended or changed or now - self._told >= AGAIN):
                    self._told = now
                    events.send("run", self._about(self._count()))
            for outlet in found:
                outlet.close()
        except Exception as error:  # whatever it is, the run goes on
            log.warning("the bus isn't told of this run any more: %s: %s", type(error).__name__, error)

    def _changed(self) -> list[_Step]:
        """Copies of the steps that are to be told of now."""
        now, found = time.monotonic(), []
        with self._lock:
            for step in self._steps.values():
                if step.told is None or (step.state == "running" and now - step.told >= AGAIN):
                    step.told = now
                    found.append(_Step(**vars(step)))
        return found

    def _count(self) -> Counter[State]:
        with self._lock:
            return Counter(step.state for step in self._steps.values())

    def _state_of(self, step: _Step) -> StepState:
        node = step.item.node.id
        seconds = None if not step.began else (step.ended or time.monotonic()) - step.began
        made = read_manifest(step.manifest) if step.state == "done" else None
        return StepState(
            run=self._run,
            tile=node.tile[:LONGEST_NAME],
            step=node.name[:LONGEST_NAME],
            state=step.state,
            progress=min(1.0, max(0.0, step.progress)),
            seconds=made.seconds if made else seconds if step.state in ("running", "failed") else None,
            memory=round(made.peak_mb * 2**20) if made else None,
            message=printable(step.message)[:LONGEST],
            host=self._host if step.state in ("running", "done", "failed") else None,
        )


@contextmanager
def published(where: str | None, command: str, source: str, *, here: bool = True) -> Iterator[PublishedRun | None]:
    """Publish how a run fares, from its beginning to its end, however that comes; None where there is no bus.

    Args:
        where: as `--bus` has it; None: nowhere.
        command: what runs.
        source: what of, as it was named.
        here: whether its steps run on this machine.

    Raises:
        SettingError: `where` is no place.
        UnavailableError: what it needs isn't installed.
    """
    if where is None:
        yield None
        return
    event_publishers.check(where)
    run = PublishedRun(where, command, source, here=here)
    try:
        yield run
    except IncompleteError as error:
        run.end("done", str(error))
        raise
    except BaseException as error:
        stopped = isinstance(error, (KeyboardInterrupt, SystemExit))
        run.end("stopped" if stopped else "failed", "" if stopped else str(error))
        raise
    run.end("done")


class PublishedRun:
    """A run whose state is published.

    Attributes:
        steps: publishes their states.
        channel: for workers elsewhere.
    """

    def __init__(self, where: str, command: str, source: str, *, here: bool) -> None:
        """Begin, as `published`."""
        self.channel = Channel(where, uuid.uuid4().hex)
        self._command, self._source, self._host = command, source, platform.node()
        self._began = time.monotonic()
        self._state: Literal["running", "done", "failed", "stopped"] = "running"
        self._message = ""
        host = self._host if here else None
        self.steps = Publisher(self.channel.run, lambda: event_publishers.opened(where), self._about, host)

    def end(self, state: Literal["done", "failed", "stopped"], message: str = "") -> None:
        """Tell how it ended."""
        self._message, self._state = message, state
        self.steps.close()

    def _about(self, steps: Counter[State]) -> RunState:
        return RunState(
            run=self.channel.run,
            command=self._command,
            source=printable(self._source)[-LONGEST_NAME:],
            host=printable(self._host)[:LONGEST_NAME],
            state=self._state,
            steps=steps.total(),
            running=steps["running"],
            done=steps["done"],
            kept=steps["kept"],
            failed=steps["failed"],
            seconds=time.monotonic() - self._began,
            message=printable(self._message)[:LONGEST],
        )


@contextmanager
def published_step(channel: Channel | None, item: Planned, store: Store) -> Iterator[Watch]:
    """Publish how one step of a run that goes on elsewhere fares, from the worker that runs it."""
    if channel is None:
        yield unwatched
        return
    publisher = Publisher(channel.run, lambda: event_publishers.opened(channel.where), host=platform.node())
    watch = publisher.watching([item], store)
    try:
        watch(item.node, "start", 0.0, "")
        yield watch
        watch(item.node, "done", 1.0, "")
    except DamagedError as error:
        watch(item.node, "again", 0.0, error.cause)
        raise
    except ScanError as error:
        watch(item.node, "failed", 1.0, error.cause)
        raise
    finally:
        publisher.close(0.0)
