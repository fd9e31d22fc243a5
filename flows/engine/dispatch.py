"""Executes a plan on workers elsewhere, such as a cluster: submits each task once its inputs exist."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from queue import SimpleQueue
from typing import Any, Protocol

from scan2sim.flows.engine.planning import PlannedTask
from scan2sim.flows.engine.ready_queue import Event, EventCallback, Outcome, ReadyQueue, ignore_event
from scan2sim.flows.pipelines.graph import Task, TaskId
from scan2sim.pipeline.core.cache import Manifest, Store
from scan2sim.pipeline.core.errors import DamagedError, ScanError, StepError, WorkerError

PROGRESS_INTERVAL_S = 1.0  # seconds between updates of `show`, which may take a tenth of a second
VISIBLE_INTERVAL_S, VISIBLE_ATTEMPTS = 1.0, 60
"""Pause and number of attempts to see a worker's result: NFS caches for up to a minute that a file is absent."""


class Future(Protocol):
    """Interface of a submitted task, implemented by Prefect's futures."""

    def add_done_callback(self, fn: Callable[[Any], None]) -> None:
        """Call `fn` once the task has ended."""

    def result(self, *, raise_on_failure: bool) -> Any:
        """The value that the task returned, or its exception."""


def dispatch(
    planned: Sequence[PlannedTask],
    store: Store,
    submit: Callable[[PlannedTask], Future],
    max_submitted: int,
    show: Callable[[str, float], None],
    on_event: EventCallback = ignore_event,
    *,
    sleep: Callable[[float], None] = time.sleep,
) -> Outcome:
    """Submit the tasks of a plan without cached results, each once its inputs exist.

    Tasks are not submitted earlier: waiting tasks would occupy workers that others could use.

    Args:
        planned: the plan.
        store: cache that workers write results to.
        submit: starts a task, which leaves its result in the store.
        max_submitted: maximum number of submitted tasks that have not ended.
        show: receives the name of a tile and the percentage of its finished tasks, at most once per second.
        on_event: receives the events of tasks that the submitting process knows; workers publish start and progress.
        sleep: pauses for some seconds.
    """
    tile_progress = TileProgress(planned, show)

    def track(task: Task, event: Event, fraction: float, message: str) -> None:
        on_event(task, event, fraction, message)
        if event != "again":
            tile_progress.end(task.id)

    queue = ReadyQueue(planned, store, track)
    running: dict[TaskId, tuple[PlannedTask, Future]] = {}
    ended: SimpleQueue[TaskId] = SimpleQueue()
    attempts = VISIBLE_ATTEMPTS
    while queue or running:
        for item in queue.ready():
            if len(running) >= max_submitted:
                break
            queue.take(item)
            running[item.task.id] = (item, submit(item))
            running[item.task.id][1].add_done_callback(partial(_notify, ended, item.task.id))
        if running:
            item, future = running.pop(ended.get())
            try:
                outcome = future.result(raise_on_failure=False)
            except Exception as error:  # the runner gives a task up after it crashed several workers
                outcome = error
            if isinstance(outcome, DamagedError):
                queue.rebuild_damaged(item, outcome)
                continue
            if isinstance(outcome, BaseException):
                manifest = _finished_elsewhere(item, store)
            else:
                manifest = _visible(item, store, attempts, sleep)
                attempts = 1 if manifest is None else attempts  # the next ones won't appear, either
            if manifest is not None:
                queue.end(item, manifest)
            else:
                queue.fail(item, _error(item, store, outcome))
    tile_progress.flush()
    return queue.outcome


def _finished_elsewhere(item: PlannedTask, store: Store) -> Manifest | None:
    """The result of a failed task from a worker that had lost its network, and so its step to another one, if any."""
    found = None if item.ignores_cache else store.find(item.task.full_name, item.key)
    return None if found is None or found.failed else found


def _visible(item: PlannedTask, store: Store, attempts: int, sleep: Callable[[float], None]) -> Manifest | None:
    """The result that a worker has written, once this machine sees it; None if it doesn't appear."""
    name = item.task.full_name
    for _ in range(attempts):
        manifest = store.find(name, item.key)
        if manifest is None:
            store.revalidate(name, item.key)
            manifest = store.find(name, item.key)
        if manifest is not None:
            return manifest
        sleep(VISIBLE_INTERVAL_S)
    return None


def _error(item: PlannedTask, store: Store, outcome: object) -> ScanError:
    """The error of a task whose result doesn't exist, from what its future returned."""
    name = item.task.full_name
    if isinstance(outcome, ScanError):
        return outcome
    if isinstance(outcome, BaseException):
        cause = f"its worker failed ({type(outcome).__name__}: {outcome})"
        remedy = (
            "After an update, restart all workers. Run again: finished steps aren't repeated; the worker's log has more"
        )
        return StepError(name, cause, remedy)
    return WorkerError(
        store.folder(name, item.key),
        "a worker reports this result, but it doesn't appear on this machine",
        "Mount the disk of --out at the same path on all machines, let workers run as the same user, or use object "
        "storage for --out",
    )


def _notify(ended: SimpleQueue[TaskId], task: TaskId, _: object) -> None:
    ended.put(task)


class TileProgress:
    """Counts the finished tasks of each tile.

    Args:
        planned: tasks of one or several tiles.
        show: receives the name of a tile and the percentage of its finished tasks.
    """

    def __init__(self, planned: Sequence[PlannedTask], show: Callable[[str, float], None]) -> None:
        self._show = show
        self._left: dict[str, set[TaskId]] = {}
        for item in planned:
            self._left.setdefault(item.task.tile, set()).add(item.task.id)
        self._steps = {name: len(tasks) for name, tasks in self._left.items()}
        self._changed: set[str] = set()
        self._next = 0.0

    def end(self, task: TaskId) -> None:
        """Record that a task has ended."""
        self._left[task.tile].discard(task)
        self._changed.add(task.tile)
        if time.monotonic() >= self._next:
            self.flush()

    def flush(self) -> None:
        """Show the tiles whose progress has changed."""
        for name in sorted(self._changed):
            self._show(name or "tile", 100.0 * (1 - len(self._left[name]) / self._steps[name]))
        self._changed.clear()
        self._next = time.monotonic() + PROGRESS_INTERVAL_S
