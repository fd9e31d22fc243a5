"""Prefect flow `tile`: one tile; and the executor of all flows, which runs each step of a tile as a Prefect task."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import scan2sim.flows.deployed.prefect_settings  # noqa: F401  # isort: skip  # before prefect
from prefect import flow, get_run_logger, task
from prefect.artifacts import create_progress_artifact, update_progress_artifact
from prefect.cache_policies import NO_CACHE
from prefect.client.schemas.objects import State
from prefect.runtime import deployment
from prefect.states import Completed

from scan2sim.flows.commands.run import run_tile
from scan2sim.flows.engine.dispatch import dispatch
from scan2sim.flows.engine.execution import Executor, run_on_worker
from scan2sim.flows.engine.lock import warning_of_local_locks
from scan2sim.flows.engine.memory import parse_memory
from scan2sim.flows.engine.planning import PlannedTask, check
from scan2sim.flows.engine.progress import PublishedRun, published
from scan2sim.flows.engine.ready_queue import Outcome, ignore_event
from scan2sim.flows.engine.shared_disk import SharedDisk, shared
from scan2sim.flows.engine.versions import versions
from scan2sim.flows.engine.workers import workers
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.pipeline.core.cache import Manifest, Store
from scan2sim.pipeline.core.errors import IncompleteError, SettingError
from scan2sim.pipeline.core.remote import is_remote

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
            With an address, a number of 0 stands for all of them.
        memory: limit of the memory of all steps on one machine, "20GB".
        cores: CPU cores per step.
        bus: publishes the progress.

    Raises:
        ScanError: this kind of workers isn't available, or there would be none.
    """
    if count == 0 and (runner == "threads" or address is None):
        raise SettingError("workers", "0 workers are those of a cluster, but no address is given", "Give a number")
    gigabytes, version, channel = parse_memory(memory), versions(), bus and bus.channel
    workers(runner, count, address)  # raises early if they aren't available

    def run(planned: list[PlannedTask], store: Store) -> Outcome:
        if address is None:
            check(planned)  # remote workers may have packages that are missing here
        missing = any(item.reason is not None for item in planned)
        if missing and (text := warning_of_local_locks(store.root)) is not None:
            get_run_logger().warning(text)
        elsewhere: AbstractContextManager[SharedDisk | None] = shared(store) if missing and address else nullcontext()
        kind, warning = runner if missing else "threads", get_run_logger().warning
        with workers(kind, count, address, warning) as there, elsewhere as disk:

            def submit(item: PlannedTask) -> Any:
                manifest = store.folder(item.task.full_name, item.key) / "manifest.json"
                work = partial(there.call, run_on_worker, item, store, gigabytes, cores, version, channel, disk)
                return run_step.submit(item.task.full_name, work, str(manifest))

            # on a cluster, each worker has its next step queued
            max_submitted = there.count if runner == "threads" else 2 * there.count
            on_event = bus.steps.track(planned, store) if bus else ignore_event
            return dispatch(planned, store, submit, max_submitted, _progress(), on_event)

    return run


def _progress() -> Callable[[str, float], None]:
    """Callback that shows the progress of a tile as an artifact of the flow run, until the server refuses one."""
    known: dict[str, Any] = {}
    refused = False

    def show(name: str, percent: float) -> None:
        nonlocal refused
        if refused:  # each further attempt may take a minute, in which no step is submitted
            return
        refused = True
        with optional_artifact():
            if name in known:
                update_progress_artifact(known[name], percent)
            else:
                known[name] = create_progress_artifact(percent, key=artifact_key("progress", name), description=name)
            refused = False

    return show


@contextmanager
def optional_artifact() -> Iterator[None]:
    """Continue with a warning without an artifact that the server refuses: its size, a rate limit, an outage."""
    try:
        yield
    except Exception as error:  # artifacts are for people: a run of hours doesn't fail because of one
        get_run_logger().warning(f"Prefect's server refused an artifact ({type(error).__name__}: {error})")


def artifact_key(*parts: str) -> str:
    """Key of an artifact, in the characters that Prefect allows: lower-case letters of ASCII, digits, dashes."""
    return re.sub(r"[^a-z0-9]+", "-", "-".join(parts).lower()).strip("-")


def absolute(parameter: str, path: str) -> str:
    """Absolute path of a flow's parameter, the same for workers that run in another folder; URLs stay as they are.

    Raises:
        SettingError: a relative path in a run of a deployment, whose worker runs it in a temporary folder.
    """
    if is_remote(path) or Path(path).is_absolute():
        return path
    if deployment.id is not None:
        cause = f"`{path}` isn't an absolute path: the worker would look for it in a temporary folder"
        raise SettingError(parameter, cause, "Give an absolute path, as the worker sees it, or a URL (s3://...)")
    return str(Path(path).absolute())


@flow(name="tile")
def tile(
    path: str, out: str, settings: dict[str, Any] | None = None, memory: str | None = None, cores: int | None = None,
    bus: str | None = None,
) -> State[str]:  # fmt: skip
    """Build the world of one tile, with a Prefect task per step in threads; the result is the path of the report."""
    path, out = absolute("path", path), absolute("out", out)
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
