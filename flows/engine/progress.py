"""Publishes the progress of a run's steps on the event bus; runs neither wait for it nor fail because of it.

`on_event` only records events. A background thread opens the outlets to the bus and publishes changes once per second;
messages that a broker doesn't accept wait on disk (`services.outbox`).
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

from scan2sim.flows.engine.planning import PlannedTask
from scan2sim.flows.engine.ready_queue import Event, EventCallback, ignore_event
from scan2sim.flows.pipelines.graph import Task, TaskId
from scan2sim.pipeline.core.cache import Store, read_manifest
from scan2sim.pipeline.core.errors import DamagedError, IncompleteError, ScanError, printable
from scan2sim.services.monitoring.events import event_publishers
from scan2sim.services.monitoring.events.schema import Events, Outlet, RunState, StepState

log = logging.getLogger(__name__)

PUBLISH_INTERVAL_S = 1.0
"""Seconds between publications of changed states."""
HEARTBEAT_INTERVAL_S = 5.0
"""Seconds after which the state of the run and of running steps is published again, unchanged, as a sign of life."""
CLOSE_TIMEOUT_S = 2.0
"""Maximum time that the end of a run waits until its last events are sent."""
MAX_MESSAGE_CHARS, MAX_NAME_CHARS = 400, 256
"""Maximum length of published messages and names."""

State = Literal["waiting", "running", "done", "cached", "failed"]
STATES: dict[Event, State] = {
    "start": "running",
    "progress": "running",
    "done": "done",
    "cached": "cached",
    "failed": "failed",
    "again": "waiting",
}


@dataclass(frozen=True)
class Channel:
    """Where the progress of a run's steps is published, for workers in other processes or on other machines.

    Attributes:
        where: value of option `--bus` (`services.monitoring.events.event_publishers`).
        run: id of the run.
    """

    where: str
    run: str


@dataclass
class _Step:
    """State of a step; times are those of the publisher's clock."""

    item: PlannedTask
    manifest: Path
    state: State = "waiting"
    progress: float = 0.0
    message: str = ""
    began: float | None = None
    ended: float | None = None
    published_at: float | None = None
    """None: the current state is not published yet."""


class Publisher:
    """Publishes the states of the steps of one run."""

    def __init__(
        self,
        run: str,
        open_outlets: Callable[[], Sequence[Outlet]],
        about: Callable[[Counter[State], bool], RunState] | None = None,
        host: str | None = None,
        *,
        clock: Callable[[], float] = time.monotonic,
        wait: Callable[[threading.Event, float], bool] = threading.Event.wait,
    ) -> None:
        """Start the background thread.

        Args:
            run: id of the run.
            open_outlets: opens the outlets to the bus.
            about: makes the state of the run from the number of its steps in each state and whether the run has ended;
                None: another process publishes it.
            host: name of the machine that runs the steps, if known.
            clock: time in seconds.
            wait: waits until an event is set, at most for some seconds; returns whether it is set.
        """
        self._clock, self._wait = clock, wait
        self._run, self._open_outlets, self._run_state, self._host = run, open_outlets, about, host
        self._steps: dict[TaskId, _Step] = {}
        self._lock, self._ended = threading.Lock(), threading.Event()
        self._run_published = -HEARTBEAT_INTERVAL_S
        self._thread = threading.Thread(target=self._publish_loop, name="publisher", daemon=True)
        self._thread.start()

    def track(self, planned: Sequence[PlannedTask], store: Store) -> EventCallback:
        """Add the steps of a plan; returns the callback for their events."""
        with self._lock:
            for item in planned:
                manifest = store.folder(item.task.full_name, item.key) / "manifest.json"
                self._steps.setdefault(item.task.id, _Step(item, manifest)).manifest = manifest
        return self.on_event

    def on_event(self, task: Task, event: Event, fraction: float, message: str) -> None:
        """Record an event: an `EventCallback` of `execution.execute`."""
        now = self._clock()
        with self._lock:
            step = self._steps[task.id]
            if event == "cached" and step.state == "done":
                return  # an earlier round of this run computed it
            if event == "start":
                step.began, step.ended = now, None
            step.state, step.progress, step.message, step.published_at = STATES[event], fraction, message, None
            if step.state not in ("waiting", "running"):
                step.ended = now

    def close(self, timeout: float = CLOSE_TIMEOUT_S) -> None:
        """Publish the last states; after `timeout` seconds that continues in the background until the process ends."""
        self._ended.set()
        self._thread.join(timeout)

    def _publish_loop(self) -> None:
        try:
            events, outlets = Events("scan2sim"), self._open_outlets()
            events.outlets.extend(outlets)
            ended = False
            while not ended:
                ended = self._wait(self._ended, PUBLISH_INTERVAL_S)
                changed, now = self._take_changed(), self._clock()
                for step in changed:
                    events.send("step", self._state_of(step))
                if self._run_state and (ended or changed or now - self._run_published >= HEARTBEAT_INTERVAL_S):
                    self._run_published = now
                    events.send("run", self._run_state(self._count(), ended))
            for outlet in outlets:
                outlet.close()
        except Exception as error:  # a failure to publish must not stop the run
            log.warning("progress is no longer published: %s: %s", type(error).__name__, error)

    def _take_changed(self) -> list[_Step]:
        """Copies of the steps whose state is to be published now; marks them as published."""
        now, changed = self._clock(), []
        with self._lock:
            for step in self._steps.values():
                if step.published_at is None or (
                    step.state == "running" and now - step.published_at >= HEARTBEAT_INTERVAL_S
                ):
                    step.published_at = now
                    changed.append(_Step(**vars(step)))
        return changed

    def _count(self) -> Counter[State]:
        with self._lock:
            return Counter(step.state for step in self._steps.values())

    def _state_of(self, step: _Step) -> StepState:
        task = step.item.task.id
        now = self._clock() if step.ended is None else step.ended
        seconds = None if step.began is None else now - step.began
        manifest = read_manifest(step.manifest) if step.state == "done" else None
        return StepState(
            run=self._run,
            tile=task.tile[:MAX_NAME_CHARS],
            step=task.name[:MAX_NAME_CHARS],
            state=step.state,
            progress=min(1.0, max(0.0, step.progress)),
            seconds=manifest.seconds if manifest else seconds if step.state in ("running", "failed") else None,
            memory=round(manifest.peak_mb * 2**20) if manifest else None,
            message=printable(step.message)[:MAX_MESSAGE_CHARS],
            host=self._host if step.state in ("running", "done", "failed") else None,
        )


@contextmanager
def published(where: str | None, command: str, source: str, *, local: bool = True) -> Iterator[PublishedRun | None]:
    """Publish the progress of a run from its start to its end or failure; yields None without a bus.

    Args:
        where: value of option `--bus`; None: don't publish.
        command: name of the command that runs.
        source: what it runs on, as the user named it.
        local: whether the steps run on this machine.

    Raises:
        SettingError: `where` is not valid.
        UnavailableError: a package that the bus needs isn't installed.
    """
    if where is None:
        yield None
        return
    event_publishers.check_address(where)
    run = PublishedRun(where, command, source, local=local)
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
        steps: publishes the states of its steps.
        channel: passed to workers in other processes.
    """

    def __init__(self, where: str, command: str, source: str, *, local: bool) -> None:
        """Start publishing; arguments as of `published`."""
        self.channel = Channel(where, uuid.uuid4().hex)
        self._command, self._source, self._host = command, source, platform.node()
        self._began = time.monotonic()
        self._state: Literal["running", "done", "failed", "stopped"] = "running"
        self._message = ""
        host = self._host if local else None
        self.steps = Publisher(self.channel.run, lambda: event_publishers.open_outlets(where), self._run_state, host)

    def end(self, state: Literal["done", "failed", "stopped"], message: str = "") -> None:
        """Publish how the run ended."""
        self._message, self._state = message, state
        self.steps.close()

    def _run_state(self, steps: Counter[State], ended: bool) -> RunState:
        return RunState(
            run=self.channel.run,
            command=self._command,
            source=printable(self._source)[-MAX_NAME_CHARS:],
            host=printable(self._host)[:MAX_NAME_CHARS],
            state=self._state if ended else "running",  # the final state is published once, as the last event
            steps=steps.total(),
            running=steps["running"],
            done=steps["done"],
            cached=steps["cached"],
            failed=steps["failed"],
            seconds=time.monotonic() - self._began,
            message=printable(self._message)[:MAX_MESSAGE_CHARS],
        )


@contextmanager
def published_step(channel: Channel | None, item: PlannedTask, store: Store) -> Iterator[EventCallback]:
    """Publish the progress of one step from the worker that runs it; the run itself is published elsewhere."""
    if channel is None:
        yield ignore_event
        return
    publisher = Publisher(channel.run, lambda: event_publishers.open_outlets(channel.where), host=platform.node())
    on_event = publisher.track([item], store)
    try:
        on_event(item.task, "start", 0.0, "")
        yield on_event
        on_event(item.task, "done", 1.0, "")
    except DamagedError as error:
        on_event(item.task, "again", 0.0, error.cause)
        raise
    except ScanError as error:
        on_event(item.task, "failed", 1.0, error.cause)
        raise
    finally:
        publisher.close(0.0)
