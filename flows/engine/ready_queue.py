"""State of a plan's execution: which tasks are ready to run, done or failed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from scan2sim.flows.engine.planning import PlannedTask
from scan2sim.flows.pipelines.graph import Task, TaskId
from scan2sim.pipeline.core.cache import Manifest, Store
from scan2sim.pipeline.core.errors import DamagedError, ScanError, StepError

Event = Literal["start", "progress", "done", "cached", "failed", "again"]
EventCallback = Callable[[Task, Event, float, str], None]
"""Receives what happens to a task: task, event, fraction done, message."""

MAX_REBUILDS = 3
"""Number of times that one damaged result is rebuilt in a run."""


def ignore_event(task: Task, event: Event, fraction: float, message: str) -> None:
    """An `EventCallback` that does nothing."""


@dataclass(frozen=True)
class Outcome:
    """Result of executing a plan.

    Attributes:
        done: results by task, cached ones included.
        failed: errors by task; tasks that depend on failed ones are neither in `done` nor in `failed`.
        side_failed: errors of side products by task.
    """

    done: Mapping[TaskId, Manifest]
    failed: Mapping[TaskId, ScanError]
    side_failed: Mapping[TaskId, ScanError] = field(default_factory=dict)

    def of_tile(self, tile: str = "") -> dict[str, Manifest]:
        """Results of one tile by task name within the tile (`poisson.terrain`)."""
        return {task.name: manifest for task, manifest in self.done.items() if task.tile == tile}

    def check(self) -> None:
        """Raise the first error of a task that isn't a side product, if any failed."""
        for error in self.failed.values():
            raise error


class ReadyQueue:
    """Tasks of a plan that are ready to run, updated as results come in.

    Attributes:
        done: results by task; `ready` adds cached ones.
        failed, side_failed: errors by task.
    """

    def __init__(self, planned: Sequence[PlannedTask], store: Store, on_event: EventCallback) -> None:
        self.done: dict[TaskId, Manifest] = {}
        self.failed: dict[TaskId, ScanError] = {}
        self.side_failed: dict[TaskId, ScanError] = {}
        self._store, self._watch = store, on_event
        self._planned = {item.task.id: item for item in planned}
        self._by_name = {item.task.full_name: item.task.id for item in planned}
        self._waiting = dict(self._planned)
        self._missing: set[TaskId] = set()  # known to have no cached result
        self._lost: set[TaskId] = set()  # failed, or depending on a failed task
        self._rebuilds: Counter[TaskId] = Counter()

    def __bool__(self) -> bool:
        return bool(self._waiting)

    @property
    def outcome(self) -> Outcome:
        """The state so far."""
        return Outcome(self.done, self.failed, self.side_failed)

    def ready(self) -> Iterator[PlannedTask]:
        """Tasks that can run now, in the plan's order; those not passed to `take` are yielded again next time."""
        for task, item in list(self._waiting.items()):
            if not self._lost.isdisjoint(item.upstream):
                self.take(item)
                self._lost.add(task)
            elif all(name in self.done for name in item.upstream):
                cached = None if task in self._missing else item.cached_result(self._store)
                if cached is None:
                    self._missing.add(task)
                    yield item
                else:
                    self.take(item)
                    self.done[task] = cached
                    self._watch(item.task, "cached", 1.0, "")

    def take(self, item: PlannedTask) -> None:
        """Record that a task was started."""
        self._waiting.pop(item.task.id, None)

    def end(self, item: PlannedTask, manifest: Manifest) -> None:
        """Record the result of a task; its inputs were intact."""
        self.done[item.task.id] = manifest
        for task in (item.task.id, *item.upstream):
            self._store.mark_verified(task.full_name, self._planned[task].key)
        self._watch(item.task, "done", 1.0, "")

    def rebuild_damaged(self, item: PlannedTask, error: DamagedError) -> None:
        """Record that a task found a damaged input: the input is rebuilt, and the task waits for it.

        A machine that finds every rebuilt result damaged (a failing disk or memory) must not keep the others busy: the
        task fails after `MAX_REBUILDS`.
        """
        damaged = self._by_name[error.where]
        if damaged in self.done:
            if self._rebuilds[damaged] == MAX_REBUILDS:
                cause = f"{damaged}, which it reads, is damaged after each of {MAX_REBUILDS} rebuilds: {error.cause}"
                remedy = "Check the disk and the memory of the machine that reads it, then run again"
                self.fail(item, StepError(item.task.full_name, cause, remedy))
                return
            self._rebuilds[damaged] += 1
            del self.done[damaged]
            self._store.discard(damaged.full_name, self._planned[damaged].key)
            self._missing.add(damaged)
            self._waiting[damaged] = self._planned[damaged]
        self._waiting[item.task.id] = item
        self._watch(item.task, "again", 0.0, f"the cached result of {damaged} is damaged: rebuilding it")

    def fail(self, item: PlannedTask, error: ScanError) -> None:
        """Record the error of a task; tasks that depend on it are dropped."""
        self.take(item)
        self._lost.add(item.task.id)
        (self.side_failed if item.task.side_product else self.failed)[item.task.id] = error
        self._watch(item.task, "failed", 1.0, error.cause)
