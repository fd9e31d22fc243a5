"""Prefect: a whole survey as a flow, from what a vehicle brought home to one world (D3.2, section 4.2)."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import flows.prefect_settings  # noqa: F401  # isort: skip  # before prefect
from prefect import flow, get_run_logger, task
from prefect.artifacts import create_image_artifact, create_markdown_artifact, create_table_artifact
from prefect.cache_policies import NO_CACHE
from prefect.client.orchestration import get_client
from prefect.task_runners import TaskRunner, ThreadPoolTaskRunner

from flows.prepare import survey_of
from flows.settings import Settings
from flows.survey_report import overview, rows
from flows.surveying import make_survey
from flows.tile import artifact_key, by_tasks
from pipeline.errors import SettingError
from pipeline.io.remote import likeness


def task_runner(name: str, workers: int, address: str | None = None) -> TaskRunner[Any]:
    """A task runner by name: "threads", "dask" or "ray", here or at a cluster's address.

    Raises:
        SettingError: there is no such runner.
    """
    if name == "threads":
        return ThreadPoolTaskRunner(max_workers=workers)
    if name == "dask":
        from prefect_dask import DaskTaskRunner

        with get_client(sync_client=True) as client:  # workers told of this run's server start none of their own
            env = {"PREFECT_API_URL": str(client.api_url)}
        with get_client(sync_client=True) as client:  # workers told of this run's server start none of their own
            env = {"PREFECT_API_URL": str(client.api_url)}
        here = {"n_workers": workers, "threads_per_worker": 1, "memory_limit": 0, "dashboard_address": ":0", "env": env}
        return DaskTaskRunner(address=address) if address else DaskTaskRunner(cluster_kwargs=here)
    if name == "ray":
        from prefect_ray import RayTaskRunner

        own = {"address": "local", "num_cpus": workers, "include_dashboard": False}
        return RayTaskRunner(address=address, init_kwargs={} if address else own)
    raise SettingError("runner", f"there is no `{name}`", "Choose threads, dask or ray")


@task(name="prepare", task_run_name="import and cut", cache_policy=NO_CACHE)
def prepare(source: str, out: str, length: float | None, buffer: float | None) -> str:
    """SLAM, import and cut, where they are needed; returns the path of the `survey.toml`."""
    return str(survey_of(source, out, length=length, buffer=buffer, say=get_run_logger().warning))


@flow(name="tiles")
def tiles(
    path: str, out: str, settings: dict[str, Any] | None, workers: int, memory: str | None, cores: int | None
) -> str:
    """All tiles of a survey and their world: a task per tile and step; returns the report's path."""
    try:
        return str(make_survey(path, out, Settings(settings), by_tasks(workers, memory, cores)))
    finally:
        publish(likeness(out))


def publish(out: Path) -> None:
    """Show how the tiles fare, their figures and a picture as artifacts of the flow run."""
    create_markdown_artifact(overview(out), key=artifact_key("survey", out.name), description="tiles by state")
    create_table_artifact(rows(out), key=artifact_key("tiles", out.name), description="figures of all tiles")
    for picture in sorted(out.glob("tiles/*/picture.jpg"))[:1]:
        pixels = base64.b64encode(picture.read_bytes()).decode()
        create_image_artifact(f"data:image/jpeg;base64,{pixels}", key=artifact_key("picture", out.name))


@flow(name="survey")
def survey(
    source: str, out: str, length: float | None = None, buffer: float | None = None,
    settings: dict[str, Any] | None = None, runner: str = "threads", workers: int = 2,
    memory: str | None = None, cores: int | None = None, address: str | None = None,
) -> str:  # fmt: skip
    """Make a survey's worlds on the runner that is named; what an earlier run has finished is kept.

    Args:
        source: a drive, a corridor or a survey (`flows.prepare`).
        out: folder for the worlds, the reports and kept results.
        length, buffer: metres, of tiles that are cut here; default: as the drive says, or 100 and 5.
        settings: by step, as in a settings file.
        runner: "threads", "dask" or "ray".
        workers: steps at a time.
        memory: what steps on one machine may need together, "20GB".
        cores: that a step may use; default: all.
        address: of a Dask scheduler or a Ray cluster; default: started here.
    """
    chosen = task_runner(runner, workers, address)
    path = prepare(source, out, length, buffer)
    return tiles.with_options(task_runner=chosen)(path, out, settings, workers, memory, cores)
