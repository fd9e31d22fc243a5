"""`scan2sim run`: builds the world of a tile and its report, in local processes, without Prefect."""

from __future__ import annotations

import json
import time
from collections.abc import Collection
from pathlib import Path
from typing import Annotated

import typer

from scan2sim.flows.commands.app import App, Bus, Config, Force, From, HoldOut, OutDir, Sets, TilePath, settings_of
from scan2sim.flows.commands.display import console, warn
from scan2sim.flows.commands.log import Log
from scan2sim.flows.commands.plan import plan_tile
from scan2sim.flows.commands.run_with_progress import execute_with_progress, show_failed, show_findings, show_results
from scan2sim.flows.engine.execution import Executor, run_to_world
from scan2sim.flows.engine.lock import locked
from scan2sim.flows.engine.planning import PlannedTask, drop_damaged
from scan2sim.flows.engine.progress import PublishedRun, published
from scan2sim.flows.engine.ready_queue import Outcome
from scan2sim.flows.engine.versions import versions
from scan2sim.flows.pipelines.graph import TaskId
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.reports.publish import publish, to_read
from scan2sim.flows.reports.side_products import SideProducts
from scan2sim.flows.reports.tile import DATA, PAGE, write_report
from scan2sim.pipeline.core.cache import Store
from scan2sim.pipeline.io.tile import read_tile

app = App()


@app.command()
def run(
    tile: TilePath,
    out: OutDir,
    set_: Sets = None,
    config: Config = None,
    hold_out: HoldOut = None,
    force: Force = False,
    from_: From = None,
    jobs: Annotated[int, typer.Option(min=0, help="Steps that run at the same time; 0: 2, or 3 from 6 cores on.")] = 0,
    bus: Bus = None,
) -> None:
    """Build the world of a tile; steps that an earlier run has finished are not repeated."""
    settings = settings_of(set_, config, hold_out)
    with published(bus, "run", str(tile)) as on_bus:
        run_tile(tile, out, settings, force=force, start=from_, jobs=jobs, bus=on_bus)


def run_tile(
    path: Path,
    out: Path,
    settings: Settings,
    *,
    force: bool = False,
    start: str | None = None,
    jobs: int = 0,
    run: Executor | None = None,
    bus: PublishedRun | None = None,
) -> Path:
    """Build the world of the tile at `path` in the folder `out`; returns the report's path.

    `out` gets `world/`, `report.html`, `report.json`, `config.json` (resolved settings), `run.log` and `steps/` (cached
    results).

    Args:
        path: a `tile.toml`, or its folder.
        out: output folder.
        settings: of all steps.
        force: repeat all steps.
        start: name of a step to repeat, with all that depend on it.
        jobs: processes at a time; 0: by the number of cores.
        run: runs the steps; default: in local processes.
        bus: publishes the progress.

    Raises:
        IncompleteError: the world is finished, but side products failed.
        ScanError: see `pipeline.core.errors`; results of earlier runs stay.
    """
    began = time.perf_counter()
    tile, side, report = read_tile(path), SideProducts(out), None
    with locked(out):
        planned, store = plan_tile(tile, out, settings, force, start)
        if drop_damaged(planned, store, to_read(store, planned, out)):
            planned, store = plan_tile(tile, out, settings, force, start)
        log = Log(out / "run.log")
        log.write(f"tile {tile.path}, settings {json.dumps(settings.values)}, versions {json.dumps(versions())}")
        missing = sum(p.reason is not None for p in planned)
        with log.errors(out):

            def execute(planned: list[PlannedTask], store: Store) -> Outcome:
                return execute_with_progress(planned, store, log, jobs, bus=bus)

            def replan(without: Collection[TaskId]) -> list[PlannedTask]:
                return plan_tile(tile, out, settings, force, start, without)[0]

            planned, outcome = run_to_world(planned, replan, store, run or execute)
            side.add(outcome.side_failed)
            done = outcome.of_tile()
            changed = publish(store, planned, done, out, tile, settings)
            with side.attempt("report", out / PAGE, out / DATA):
                seconds = time.perf_counter() - began
                report = write_report(tile, planned, done, store, out, seconds=seconds, failed=side.failed)
            log.write_failed(side)
        store.sweep({p.task.id.name: p.key for p in planned})
    for warning in changed:
        warn(warning)
    show_failed(side, log)
    show_findings(done)
    show_results(out / "world" / f"{tile.name}.sdf", report)
    if missing == 0:
        console.print(f"[dim]nothing to do: the world is up to date ({time.perf_counter() - began:.1f} s)")
    side.check()
    assert report is not None, "side.check() raises if there is no report"
    return report
