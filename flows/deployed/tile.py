"""Prefect: one tile as a flow, and what every flow runs its steps with: a task per tile and step."""

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
from scan2sim.flows.engine.memory import parse
from scan2sim.flows.engine.planning import Planned, check
from scan2sim.flows.engine.progress import PublishedRun, published
from scan2sim.flows.engine.ready_queue import Outcome, unwatched
from scan2sim.flows.engine.versions import versions
from scan2sim.flows.engine.workers import workers
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.pipeline.core.cache import Manifest, Store
from scan2sim.pipeline.core.errors import IncompleteError

WITH_WARNINGS = "CompletedWithWarnings"
"""Name of a flow's final state where the world is finished, but side products failed."""


@task(name="step", task_run_name="{node}", cache_policy=NO_CACHE)
def run_step(node: str, work: Callable[[], Manifest], manifest: str) -> str:
    """Have a worker run a step, and wait for it; returns its manifest's path."""
    log, done = get_run_logger(), work()
    for line in [done.facts["told"]] if "told" in done.facts else []:
        log.info(line)
    for line in done.warnings:
        log.warning(line)
    return manifest


def by_tasks(
    runner: str = "threads", count: int = 2, address: str | None = None,
    memory: str | None = None, cores: int | None = None, bus: PublishedRun | None = None,
) -> Executor:  # fmt: skip
    """Runs plans as tasks of the flow that it is called in.

    Args:
        runner, count, address: of the workers (`engine.workers`), which are there while there is work.
        memory: what steps on one machine may need together, "20GB".
        cores: that a step may use.
        bus: that is told how steps fare.

    Raises:
        ScanError: there are no such workers.
    """
    gigabytes, version, channel = parse(memory), versions(), bus and bus.channel
    workers(runner, count, address)  # tells early of what there isn't

    def run(planned: list[Planned], store: Store) -> Outcome:
        if address is None:
            check(planned)  # workers elsewhere may have what is missing here
        missing = any(item.reason is not None for item in planned)
        with workers(runner if missing else "threads", count, address) as call:

            def submit(item: Planned) -> Any:
                manifest = store.folder(item.node.full_name, item.key) / "manifest.json"
                work = partial(call, run_on_worker, item, store, gigabytes, cores, version, channel)
                return run_step.submit(item.node.full_name, work, str(manifest))

            # those of a cluster find their next step waiting
            at_once = count if runner == "threads" else 2 * count
            watch = bus.steps.watching(planned, store) if bus else unwatched
            return dispatch(planned, store, submit, at_once, _progress(), watch)

    return run


def _progress() -> Callable[[str, float], None]:
    """Shows a tile's progress as an artifact of the flow run."""
    known: dict[str, Any] = {}

    def show(name: str, percent: float) -> None:
        if name in known:
            update_progress_artifact(known[name], percent)
        else:
            known[name] = create_progress_artifact(percent, key=artifact_key("progress", name), description=name)

    return show


def artifact_key(*parts: str) -> str:
    """A key as Prefect allows it: lower-case letters, digits, dashes."""
    return "-".join(parts).lower().replace("_", "-")


@flow(name="tile")
def tile(
    path: str, out: str, settings: dict[str, Any] | None = None, memory: str | None = None, cores: int | None = None,
    bus: str | None = None,
) -> State[str]:  # fmt: skip
    """Make one tile's world, a task a step, in threads of this process; the result is the report's path."""
    try:
        with published(bus, "tile", path, here=False) as on_bus:
            run = by_tasks(memory=memory, cores=cores, bus=on_bus)
            report = str(run_tile(Path(path), Path(out), Settings(settings), run=run))
    except IncompleteError as error:
        return with_warnings(error, Path(out) / "report.html")
    return Completed(message=f"The world is finished: {report}", data=report)


def with_warnings(error: IncompleteError, report: Path) -> State[str]:
    """The final state of a flow whose world is finished, but side products failed."""
    get_run_logger().warning(str(error))
    return Completed(name=WITH_WARNINGS, message=error.cause, data=str(report))
