"""Prefect: one tile as a flow, and what every flow runs its steps with: a task per tile and step."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import flows.prefect_settings  # noqa: F401  # isort: skip  # before prefect
from prefect import flow, get_run_logger, task
from prefect.artifacts import create_progress_artifact, update_progress_artifact
from prefect.cache_policies import NO_CACHE
from prefect.client.orchestration import get_client
from prefect.settings import PREFECT_API_URL

from flows.dispatch import dispatch
from flows.execute import Executor, check_version, limit_cores, run_apart, versions
from flows.memory import need, parse, share
from flows.planning import Planned
from flows.run import run_tile
from flows.settings import Settings
from pipeline.errors import ScanError, UnavailableError
from pipeline.store import Manifest, Store


@task(name="step", task_run_name="{label}", cache_policy=NO_CACHE)
def run_step(label: str, item: Planned, store: Store, limits: dict[str, Any], version: dict[str, str]) -> str:
    """Run a step where the task runner has put it, in a process of its own; returns its manifest's path."""
    check_version(item, version)
    log = get_run_logger()
    limit_cores(limits["cores"])
    with share(limits["memory"], need(item, store)):
        manifest = run_apart(item, store, lambda *_: None)
    for line in [manifest.facts["told"]] if "told" in manifest.facts else []:
        log.info(line)
    for line in manifest.warnings:
        log.warning(line)
    return str(store.folder(label, item.key) / "manifest.json")


def by_tasks(workers: int = 2, memory: str | None = None, cores: int | None = None) -> Executor:
    """Runs plans as tasks of the flow that it is called in.

    Args:
        workers: how many steps the task runner can run at a time; twice as many are submitted.
        memory: what steps on one machine may need together, "20GB".
        cores: that a step may use.
    """
    limits, version = {"memory": parse(memory), "cores": cores}, versions()

    def run(planned: list[Planned], store: Store, failures: dict[str, ScanError]) -> dict[str, Manifest]:
        def submit(item: Planned) -> Any:
            return run_step.submit(item.node.label, item, store, limits, version)

        return dispatch(planned, store, failures, submit, 2 * workers, _progress())

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


def check_server() -> None:
    """Find out early whether the server that is named answers.

    Raises:
        UnavailableError: it doesn't.
    """
    url = PREFECT_API_URL.value()
    if url is not None:  # else a server of its own is started
        with get_client(sync_client=True) as client:
            problem = client.api_healthcheck()
        if problem is not None:
            remedy = "Start it (`prefect server start`), or unset PREFECT_API_URL to run without one"
            raise UnavailableError(url, f"Prefect's server doesn't answer ({problem})", remedy)


@flow(name="tile")
def tile(
    path: str, out: str, settings: dict[str, Any] | None = None, memory: str | None = None, cores: int | None = None
) -> str:
    """Make one tile's world, a task a step, in threads of this process; returns the report's path."""
    return str(run_tile(Path(path), Path(out), Settings(settings), run=by_tasks(memory=memory, cores=cores)))
