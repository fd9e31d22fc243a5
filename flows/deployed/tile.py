"""Prefect flow `tile`: one tile; and the executor of all flows, which runs each step of a tile as a Prefect task."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import scan2sim.flows.deployed.prefect_settings  # noqa: F401  # isort: skip  # before prefect
from prefect import flow, get_run_logger, task
from prefect.artifacts import create_progress_artifact, update_progress_artifact
from prefect.cache_policies import NO_CACHE
from prefect.client.schemas.objects import State
from prefect.states import Completed

from scan2sim.flows.commands.run import run_tile
from scan2sim.flows.engine.dispatch import dispatch
from scan2sim.flows.engine.execution import Executor, run_on_worker
from scan2sim.flows.engine.memory import parse_memory
from scan2sim.flows.engine.planning import PlannedTask, check
from scan2sim.flows.engine.progress import PublishedRun, published
from scan2sim.flows.engine.ready_queue import Outcome, ignore_event
from scan2sim.flows.engine.versions import versions
from scan2sim.flows.engine.workers import workers
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.pipeline.core.cache import Manifest, Store
from scan2sim.pipeline.core.errors import IncompleteError

WITH_WARNINGS = "CompletedWithWarnings"
"""Name of the final state of a flow whose world is finished, but side products failed."""


@task(name="step", task_run_name="{name}", cache_policy=NO_CACHE)
def run_step(name: str, work: Callable[[], Manifest], manifest: str) -> str:
    """Run a step on a worker and wait for it; returns the path of its manifest."""
    log, done = get_run_logger(), work()
    for line in [done.metrics["summary"]] if "summary" in done.metrics else []:
        log.info(line)
    for line in done.warnings:
        log.warning(line)
    return manifest


def prefect_executor(
    runner: str = "threads", count: int = 2, address: str | None = None,
    memory: str | None = None, cores: int | None = None, bus: PublishedRun | None = None,
) -> Executor:  # fmt: skip
    """Executor that runs plans as Prefect tasks of the flow that calls it.

    Args:
        runner, count, address: kind, number and address of the workers (`engine.workers`); they run only during a plan.
        memory: limit of the memory of all steps on one machine, "20GB".
        cores: CPU cores per step.
        bus: publishes the progress.

    Raises:
        ScanError: this kind of workers isn't available.
    """
    gigabytes, version, channel = parse_memory(memory), versions(), bus and bus.channel
    workers(runner, count, address)  # raises early if they aren't available

    def run(planned: list[PlannedTask], store: Store) -> Outcome:
        if address is None:
            check(planned)  # remote workers may have packages that are missing here
        missing = any(item.reason is not None for item in planned)
        with workers(runner if missing else "threads", count, address) as call:

            def submit(item: PlannedTask) -> Any:
                manifest = store.folder(item.task.full_name, item.key) / "manifest.json"
                work = partial(call, run_on_worker, item, store, gigabytes, cores, version, channel)
                return run_step.submit(item.task.full_name, work, str(manifest))

            # on a cluster, each worker has its next step queued
            max_submitted = count if runner == "threads" else 2 * count
            on_event = bus.steps.track(planned, store) if bus else ignore_event
            return dispatch(planned, store, submit, max_submitted, _progress(), on_event)

    return run


def _progress() -> Callable[[str, float], None]:
    """Callback that shows the progress of a tile as an artifact of the flow run."""
    known: dict[str, Any] = {}

    def show(name: str, percent: float) -> None:
        if name in known:
            update_progress_artifact(known[name], percent)
        else:
            known[name] = create_progress_artifact(percent, key=artifact_key("progress", name), description=name)

    return show


def artifact_key(*parts: str) -> str:
    """Key of an artifact, in the characters that Prefect allows: lower-case letters, digits, dashes."""
    return "-".join(parts).lower().replace("_", "-")


@flow(name="tile")
def tile(
    path: str, out: str, settings: dict[str, Any] | None = None, memory: str | None = None, cores: int | None = None,
    bus: str | None = None,
) -> State[str]:  # fmt: skip
    """Build the world of one tile, with a Prefect task per step in threads; the result is the path of the report."""
    try:
        with published(bus, "tile", path, local=False) as on_bus:
            run = prefect_executor(memory=memory, cores=cores, bus=on_bus)
            report = str(run_tile(Path(path), Path(out), Settings(settings), run=run))
    except IncompleteError as error:
        return with_warnings(error, Path(out) / "report.html")
    return Completed(message=f"The world is finished: {report}", data=report)


def with_warnings(error: IncompleteError, report: Path) -> State[str]:
    """The final state of a flow whose world is finished, but side products failed."""
    get_run_logger().warning(str(error))
    return Completed(name=WITH_WARNINGS, message=error.cause, data=str(report))
