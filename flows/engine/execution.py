"""Runs a plan: what is missing, in processes; every result is kept in the store."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerProcess

from scan2sim.flows.engine import processes
from scan2sim.flows.engine.memory import need, share
from scan2sim.flows.engine.planning import Planned, check
from scan2sim.flows.engine.progress import Channel, published_step
from scan2sim.flows.engine.ready_queue import Frontier, Outcome, Watch
from scan2sim.flows.engine.versions import check_version
from scan2sim.flows.pipelines.graph import NodeId
from scan2sim.pipeline.core import system_libs
from scan2sim.pipeline.core.cache import Manifest, Store
from scan2sim.pipeline.core.errors import DamagedError, ScanError

Executor = Callable[[list[Planned], Store], Outcome]
"""Runs what a plan says is missing."""


def execute(
    planned: Sequence[Planned],
    store: Store,
    *,
    jobs: int,
    watch: Watch,
    to_the_end: bool = False,
    memory: float | None = None,
) -> Outcome:
    """Run what the plan says is missing, up to `jobs` nodes at a time, each in a process of its own.

    Args:
        to_the_end: run all that doesn't depend on what has failed, rather than stop at the first failure. Side
            products never stop a run.
        memory: GB that nodes may need together (`engine.memory`); one that needs more runs alone.

    Raises:
        ScanError: of a node that can't run here, before any does.
        KeyboardInterrupt: what was finished is kept.
    """
    check(planned)
    front = Frontier(planned, store, watch)
    running: dict[Connection, tuple[Planned, ForkServerProcess, float]] = {}
    try:
        while front or running:
            for item in front.ready():
                if len(running) >= jobs:
                    break
                try:
                    needed = 0.0 if memory is None else need(item, store)
                    if memory is not None and running and sum(r[2] for r in running.values()) + needed > memory:
                        continue
                    started, process = processes.start(item, store)
                except DamagedError as error:
                    front.again(item, error)
                    break
                front.take(item)
                watch(item.node, "start", 0.0, "")
                running[started] = (item, process, needed)
            for connection in wait(list(running), timeout=1.0) if running else ():
                assert isinstance(connection, Connection)
                item, process, _ = running[connection]
                try:
                    manifest = processes.receive(connection, item, process, watch)
                except DamagedError as error:
                    front.again(item, error)
                except ScanError as error:
                    front.fail(item, error)
                    if not (to_the_end or item.node.step.side_product):
                        return front.outcome
                else:
                    if manifest is None:
                        continue
                    front.end(item, manifest)
                process.join()
                del running[connection]
    finally:
        for _, process, _ in running.values():
            processes.stop(process)
    return front.outcome


def run_to_world(
    planned: list[Planned], plan: Callable[[Collection[NodeId]], list[Planned]], store: Store, run: Executor
) -> tuple[list[Planned], Outcome]:
    """Run a plan; where side products fail, again without them, until nothing more fails.

    Args:
        planned: what to run first.
        plan: plans without the side products that failed.
        store: that keeps results.
        run: runs a plan.

    Returns:
        The last plan and its outcome, with all side products that failed.

    Raises:
        ScanError: of a node that isn't a side product.
    """
    failed: dict[NodeId, ScanError] = {}
    made: dict[NodeId, str] = {}
    while True:
        outcome = run(planned, store)
        outcome.check()
        if not outcome.side_failed:
            return planned, replace(outcome, side_failed=failed)
        failed |= outcome.side_failed
        made |= {item.node.id: item.key for item in planned if item.node.id in outcome.done}
        # what was forced to run again has by now
        planned = [replace(item, reason=None) if made.get(item.node.id) == item.key else item for item in plan(failed)]


def limit_cores(cores: int | None) -> None:
    """Let steps that this process starts use so many cores each; None: all. Counts from the first step on."""
    if cores is not None:
        for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENCV_FOR_THREADS_NUM", "OPENBLAS_NUM_THREADS"):
            os.environ[name] = str(cores)


def run_apart(item: Planned, store: Store, watch: Watch) -> Manifest:
    """Run one node in a process of its own and wait for it; a result that is there by now is kept.

    Raises:
        ScanError: as `run_node`.
    """
    kept = item.kept(store)
    if kept is not None:
        return kept
    connection, process = processes.start(item, store)
    try:
        while True:
            manifest = processes.receive(connection, item, process, watch)
            if manifest is not None:
                process.join()
                return manifest
    finally:
        processes.stop(process)


def run_on_worker(
    item: Planned,
    store: Store,
    memory: float | None,
    cores: int | None,
    wanted: Mapping[str, str],
    channel: Channel | None = None,
) -> Manifest:
    """Run one node as a worker that serves a flow elsewhere.

    Args:
        memory: GB that steps on one machine may need together (`engine.memory`).
        cores: that the step may use.
        wanted: the flow's `versions()`.
        channel: where the bus is told of the flow's run; None: nowhere.

    Raises:
        UnavailableError: this worker has other versions, or lacks libraries.
        ScanError: as `run_node`.
    """
    check_version(item, wanted)
    system_libs.check()
    limit_cores(cores)
    os.environ.pop("MALLOC_TRIM_THRESHOLD_", None)  # Dask's, for processes that live on: it slows steps down
    with share(memory, need(item, store)), published_step(channel, item, store) as watch:
        return run_apart(item, store, watch)
