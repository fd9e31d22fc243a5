"""Executes a plan in local processes: runs the tasks without cached results, and caches each result."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerProcess

from scan2sim.flows.engine import processes
from scan2sim.flows.engine.memory import expected_memory, reserve_memory
from scan2sim.flows.engine.planning import PlannedTask, check
from scan2sim.flows.engine.progress import Channel, published_step
from scan2sim.flows.engine.ready_queue import EventCallback, Outcome, ReadyQueue
from scan2sim.flows.engine.shared_disk import SharedDisk
from scan2sim.flows.engine.versions import check_version
from scan2sim.flows.pipelines.graph import TaskId
from scan2sim.pipeline.core import system_libs
from scan2sim.pipeline.core.cache import Manifest, Store
from scan2sim.pipeline.core.cores import THREAD_VARIABLES
from scan2sim.pipeline.core.errors import DamagedError, ScanError, WorkerError

Executor = Callable[[list[PlannedTask], Store], Outcome]
"""Runs the tasks of a plan that have no cached results."""


def execute(
    planned: Sequence[PlannedTask],
    store: Store,
    *,
    jobs: int,
    on_event: EventCallback,
    keep_going: bool = False,
    memory: float | None = None,
) -> Outcome:
    """Run the tasks of a plan that have no cached results, up to `jobs` at a time, each in a process of its own.

    Args:
        planned: the plan.
        store: cache of the results.
        jobs: maximum number of processes.
        on_event: receives start, progress and end of each task.
        keep_going: after a failure, run all tasks that don't depend on the failed one; default: stop. Failed side
            products never stop a run.
        memory: GB that tasks may use together (`engine.memory`); a task that needs more runs alone.

    Raises:
        ScanError: a task can't run on this machine; raised before any task starts.
        KeyboardInterrupt: results of finished tasks are cached.
    """
    check(planned)
    queue = ReadyQueue(planned, store, on_event)
    running: dict[Connection, tuple[PlannedTask, ForkServerProcess, float]] = {}
    try:
        while queue or running:
            for item in queue.ready():
                if len(running) >= jobs:
                    break
                try:
                    needed = 0.0 if memory is None else expected_memory(item, store)
                    if memory is not None and running and sum(r[2] for r in running.values()) + needed > memory:
                        continue
                    started, process = processes.start(item, store)
                except DamagedError as error:
                    queue.rebuild_damaged(item, error)
                    break
                queue.take(item)
                on_event(item.task, "start", 0.0, "")
                running[started] = (item, process, needed)
            for connection in wait(list(running), timeout=1.0) if running else ():
                assert isinstance(connection, Connection)
                item, process, _ = running[connection]
                try:
                    manifest = processes.receive(connection, item, process, on_event)
                except DamagedError as error:
                    queue.rebuild_damaged(item, error)
                except ScanError as error:
                    queue.fail(item, error)
                    if not (keep_going or item.task.side_product):
                        return queue.outcome
                else:
                    if manifest is None:
                        continue
                    queue.end(item, manifest)
                process.join()
                del running[connection]
    finally:
        for _, process, _ in running.values():
            processes.stop(process)
    return queue.outcome


def run_to_world(
    planned: list[PlannedTask], plan: Callable[[Collection[TaskId]], list[PlannedTask]], store: Store, run: Executor
) -> tuple[list[PlannedTask], Outcome]:
    """Run a plan; if side products fail, plan and run again without them, until nothing fails.

    Args:
        planned: the first plan.
        plan: makes a plan without the side products that failed.
        store: cache of the results.
        run: runs a plan.

    Returns:
        The last plan and its outcome, with all side products that failed.

    Raises:
        ScanError: a task that isn't a side product failed.
    """
    failed: dict[TaskId, ScanError] = {}
    made: dict[TaskId, str] = {}
    while True:
        outcome = run(planned, store)
        outcome.check()
        if not outcome.side_failed:
            return planned, replace(outcome, side_failed=failed)
        failed |= outcome.side_failed
        made |= {item.task.id: item.key for item in planned if item.task.id in outcome.done}
        # a task that was forced to run has run in this loop already
        planned = [replace(item, reason=None) if made.get(item.task.id) == item.key else item for item in plan(failed)]


def limit_cores(cores: int | None) -> None:
    """Limit the CPU cores of each step that this process starts (None: all); call it before the first step starts."""
    if cores is not None:
        for name in THREAD_VARIABLES:
            os.environ[name] = str(cores)


def run_in_subprocess(item: PlannedTask, store: Store, on_event: EventCallback) -> Manifest:
    """Run one task in a process of its own and wait for it; returns at once if its result is cached by now.

    Raises:
        ScanError: as `run_task`.
    """
    cached = item.cached_result(store)
    if cached is not None:
        return cached
    connection, process = processes.start(item, store)
    try:
        while True:
            manifest = processes.receive(connection, item, process, on_event)
            if manifest is not None:
                process.join()
                return manifest
    finally:
        processes.stop(process)


def run_on_worker(
    item: PlannedTask,
    store: Store,
    memory: float | None,
    cores: int | None,
    wanted: Mapping[str, str],
    channel: Channel | None = None,
    disk: SharedDisk | None = None,
) -> Manifest:
    """Run one task on a worker, for a flow in another process or on another machine.

    Args:
        item: the task.
        store: cache of the results.
        memory: GB that tasks on one machine may use together (`engine.memory`); None: no limit.
        cores: CPU cores that the step may use; None: all.
        wanted: the flow's `versions()`.
        channel: where to publish the progress of the flow's run; None: nowhere.
        disk: the flow's disk, for a worker that may be on another machine.

    Raises:
        WorkerError: this worker has other versions, or doesn't see the flow's disk.
        UnavailableError: system libraries are missing.
        ScanError: as `run_task`; names the machine if it isn't the flow's.
    """
    try:
        if disk is not None:
            disk.check(store)
        check_version(item, wanted)
        system_libs.check()
        limit_cores(cores)
        os.environ.pop("MALLOC_TRIM_THRESHOLD_", None)  # set by Dask for long-lived processes; it slows steps down
        with reserve_memory(memory, expected_memory(item, store)), published_step(channel, item, store) as on_event:
            return run_in_subprocess(item, store, on_event)
    except ScanError as error:
        if disk is not None and not isinstance(error, WorkerError):  # these name the machine
            disk.name_worker(error)
        raise
