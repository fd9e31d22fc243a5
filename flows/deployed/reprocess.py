"""Prefect flow `reprocess`, for schedules: detects changes since the last run and rebuilds what depends on them."""

from __future__ import annotations

from typing import Any

import scan2sim.flows.deployed.prefect_settings  # noqa: F401  # isort: skip  # before prefect
from prefect import flow, get_run_logger
from prefect.client.schemas.objects import State
from prefect.states import Completed

from scan2sim.flows.commands.drive import survey_of
from scan2sim.flows.commands.survey import changes
from scan2sim.flows.deployed.survey import survey
from scan2sim.flows.deployed.tile import WITH_WARNINGS, absolute, prefect_executor
from scan2sim.flows.engine.progress import published
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.pipeline.core.errors import BusyError


@flow(name="reprocess")
def reprocess(
    source: str, out: str, length: float | None = None, buffer: float | None = None,
    settings: dict[str, Any] | None = None, runner: str = "threads", workers: int = 2,
    memory: str | None = None, cores: int | None = None, address: str | None = None, bus: str | None = None,
) -> State[Any]:  # fmt: skip
    """Rebuild what depends on new or changed clouds, photos, poses, settings or steps; arguments as for `survey`.

    Does nothing if nothing has changed, or if the previous run is still running.
    """
    source, out = absolute("source", source), absolute("out", out)
    try:
        with published(bus, "reprocess", source, local=False) as on_bus:
            run = prefect_executor(runner, workers, address, memory, cores, on_bus)
            path = survey_of(source, out, run, length=length, buffer=buffer)
        changed_tiles = changes(path, out, Settings(settings))
        for tile, reasons in changed_tiles.items():
            get_run_logger().info(f"{tile}: {reasons}")
        if not changed_tiles:
            return Completed(message="Nothing has changed")
        state = survey(path, out, None, None, settings, runner, workers, memory, cores, address, bus, return_state=True)
        report = state.result()
    except BusyError as error:
        return Completed(message=f"Skipped: {error}", name="Skipped")
    if state.name == WITH_WARNINGS:
        return Completed(name=WITH_WARNINGS, message=state.message, data=report)
    return Completed(message=f"{len(changed_tiles)} tiles rebuilt: {report}", data=report)
