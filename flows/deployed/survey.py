"""Prefect flow `survey`: a whole survey, from the recordings of a drive to one world (5G-ERA D3.2, section 4.2)."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import scan2sim.flows.deployed.prefect_settings  # noqa: F401  # isort: skip  # before prefect
from prefect import flow
from prefect.artifacts import create_image_artifact, create_markdown_artifact, create_table_artifact
from prefect.client.schemas.objects import State
from prefect.states import Completed

from scan2sim.flows.commands.drive import survey_of
from scan2sim.flows.commands.survey import make_survey
from scan2sim.flows.deployed.tile import absolute, artifact_key, optional_artifact, prefect_executor, with_warnings
from scan2sim.flows.engine.progress import published
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.reports.survey import PAGE, overview, rows
from scan2sim.pipeline.core.errors import IncompleteError, StepError
from scan2sim.pipeline.core.remote import local_copy


def publish(out: Path) -> None:
    """Publish the states and metrics of the tiles and an image as artifacts of the flow run."""
    summary, table = overview(out), rows(out)
    with optional_artifact():
        create_markdown_artifact(summary, key=artifact_key("survey", out.name), description="tiles by state")
    with optional_artifact():
        create_table_artifact(table, key=artifact_key("tiles", out.name), description="metrics of all tiles")
    for picture in sorted(out.glob("tiles/*/picture.jpg"))[:1]:
        pixels = base64.b64encode(picture.read_bytes()).decode()
        with optional_artifact():
            create_image_artifact(f"data:image/jpeg;base64,{pixels}", key=artifact_key("picture", out.name))


@flow(name="survey")
def survey(
    source: str, out: str, length: float | None = None, buffer: float | None = None,
    settings: dict[str, Any] | None = None, runner: str = "threads", workers: int = 2,
    memory: str | None = None, cores: int | None = None, address: str | None = None, bus: str | None = None,
) -> State[str]:  # fmt: skip
    """Build the worlds of a survey, with a Prefect task per tile and step; finished steps are not repeated.

    The result is the path of the report.

    Args:
        source: a drive, a corridor or a survey (`commands.drive`).
        out: output folder for worlds, reports and cached results.
        length, buffer: tile length and overlap in metres if the source is cut; default: of the drive, or 100 and 5.
        settings: by step, as in a settings file.
        runner: "threads", "dask" or "ray": where steps run (`engine.workers`).
        workers: number of steps that run at the same time; 0, with an address: as many as its workers.
        memory: limit of the memory of all steps on one machine, "20GB".
        cores: CPU cores per step; default: all.
        address: of a Dask scheduler or a Ray cluster; default: start one here.
        bus: where the flow and its workers publish progress (`services.monitoring.events.event_publishers`).
    """
    source, out = absolute("source", source), absolute("out", out)
    try:
        with published(bus, "survey", source, local=False) as on_bus:
            run = prefect_executor(runner, workers, address, memory, cores, on_bus)
            path = survey_of(source, out, run, length=length, buffer=buffer)
            try:
                report = str(make_survey(path, out, Settings(settings), run))
            except (StepError, IncompleteError):  # some tiles or side products failed; the others are finished
                publish(local_copy(out))
                raise
    except IncompleteError as error:
        return with_warnings(error, local_copy(out) / PAGE)
    publish(local_copy(out))
    return Completed(message=f"The world is finished: {report}", data=report)
