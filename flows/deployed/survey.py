"""Prefect: a whole survey as a flow, from what a vehicle brought home to one world (D3.2, section 4.2)."""

from __future__ import annotations

import base64
import os
import signal
import sys
from pathlib import Path
from typing import Any

import scan2sim.flows.deployed.prefect_settings  # noqa: F401  # isort: skip  # before prefect
from prefect import flow
from prefect.artifacts import create_image_artifact, create_markdown_artifact, create_table_artifact
from prefect.client.orchestration import get_client
from prefect.client.schemas.objects import State
from prefect.settings import PREFECT_API_URL
from prefect.states import Completed

from scan2sim.flows.commands.drive import survey_of
from scan2sim.flows.commands.survey import make_survey
from scan2sim.flows.deployed.prefect_server_guard import guard
from scan2sim.flows.deployed.tile import artifact_key, by_tasks, with_warnings
from scan2sim.flows.engine.progress import published
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.reports.survey import PAGE, overview, rows
from scan2sim.pipeline.core.errors import INTERRUPTED, IncompleteError, StepError, UnavailableError, exit_code
from scan2sim.pipeline.io.remote import likeness


def check_server() -> None:
    """Find out early whether the server that is named answers; without one the run starts its own.

    Ctrl-C interrupts that one, too, and Prefect would try for minutes to tell it: the process ends at once instead.

    Raises:
        UnavailableError: it doesn't answer.
    """
    url = PREFECT_API_URL.value()
    if url is None:
        signal.signal(signal.SIGINT, _end)
        guard()
        return
    with get_client(sync_client=True) as client:
        problem = client.api_healthcheck()
    if problem is not None:
        remedy = "Start it (`prefect server start`), or unset PREFECT_API_URL to run without one"
        raise UnavailableError(url, f"Prefect's server doesn't answer ({problem})", remedy)


def _end(*_: object) -> None:
    from prefect.server.api.server import SubprocessASGIServer  # slow, and loaded by now where there is one

    SubprocessASGIServer().stop()
    print(INTERRUPTED, file=sys.stderr, flush=True)
    os._exit(exit_code(KeyboardInterrupt()))


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
    memory: str | None = None, cores: int | None = None, address: str | None = None, bus: str | None = None,
) -> State[str]:  # fmt: skip
    """Make a survey's worlds, a task per tile and step; what an earlier run has finished is kept.

    The result is the report's path.

    Args:
        source: a drive, a corridor or a survey (`commands.drive`).
        out: folder for the worlds, the reports and kept results.
        length, buffer: metres, of tiles that are cut here; default: as the drive says, or 100 and 5.
        settings: by step, as in a settings file.
        runner: "threads", "dask" or "ray": where steps run (`engine.workers`).
        workers: steps at a time.
        memory: what steps on one machine may need together, "20GB".
        cores: that a step may use; default: all.
        address: of a Dask scheduler or a Ray cluster; default: started here.
        bus: that is told how steps fare, by the flow and by its workers
        (`services.monitoring.export.event_publishers`).
    """
    try:
        with published(bus, "survey", source, here=False) as on_bus:
            run = by_tasks(runner, workers, address, memory, cores, on_bus)
            path = survey_of(source, out, run, length=length, buffer=buffer)
            try:
                report = str(make_survey(path, out, Settings(settings), run))
            except (StepError, IncompleteError):  # tiles or side products failed, all else is there
                publish(likeness(out))
                raise
    except IncompleteError as error:
        return with_warnings(error, likeness(out) / PAGE)
    publish(likeness(out))
    return Completed(message=f"The world is finished: {report}", data=report)
