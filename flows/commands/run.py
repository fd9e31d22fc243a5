"""`scan2sim run`: builds the world of a tile and its report, in local processes, without Prefect."""

from __future__ import annotations

import json
import time
from collections.abc import Collection
from pathlib import Path
from typing import Annotated

import typer

from scan2sim.flows.commands.app import App, Bus, Config, Force, From, HoldOut, OutDir, Sets, settings_of
from scan2sim.flows.commands.display import console, warn
from scan2sim.flows.commands.log import Log
from scan2sim.flows.commands.plan import plan_tile
from scan2sim.flows.commands.robot_map import (
    ClassesFromColours,
    NoImages,
    Scene,
    SensorPath,
    Units,
    Up,
    is_map,
    map_params,
    tile_of_map,
)
from scan2sim.flows.commands.run_with_progress import execute_with_progress, show_failed, show_findings, show_results
from scan2sim.flows.commands.unchanged import Watch
from scan2sim.flows.engine.execution import Executor, run_to_world
from scan2sim.flows.engine.lock import locked
from scan2sim.flows.engine.output_folder import check_own
from scan2sim.flows.engine.planning import PlannedTask, drop_damaged
from scan2sim.flows.engine.progress import PublishedRun, published
from scan2sim.flows.engine.ready_queue import Outcome
from scan2sim.flows.engine.versions import versions
from scan2sim.flows.pipelines.graph import TaskId, source_paths
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.tile import build_graph
from scan2sim.flows.reports.publish import PUBLISHED_OUTPUTS, publish, to_read
from scan2sim.flows.reports.side_products import SideProducts
from scan2sim.flows.reports.tile import DATA, PAGE, write_report
from scan2sim.pipeline.core.cache import Store
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.io.tile import read_tile, source_files

app = App()
RESULTS = (*(folder for _, folder in PUBLISHED_OUTPUTS.values()), PAGE, DATA, "config.json", "exposure.json")
"""Files and folders that a run writes into its output folder."""


@app.command()
def run(
    tile: Annotated[
        Path,
        typer.Argument(
            metavar="TILE",
            help="Tile (clouds and photos, see `scan2sim import`): its folder or tile.toml; or a robot's map: a point "
            "cloud, or a folder of clouds.",
        ),
    ],
    out: OutDir,
    set_: Sets = None,
    config: Config = None,
    hold_out: HoldOut = None,
    force: Force = False,
    from_: From = None,
    jobs: Annotated[
        int,
        typer.Option(min=0, help="Steps that run at the same time; 0: 2, or 3 from 6 cores on, as free memory allows."),
    ] = 0,
    bus: Bus = None,
    up: Up = "auto",
    units: Units = "auto",
    scene: Scene = "auto",
    trajectory: SensorPath = None,
    no_images: NoImages = False,
    classes_from_colours: ClassesFromColours = "",
) -> None:
    """Build the world of a tile, or of a robot's map; steps that an earlier run has finished are not repeated."""
    settings = settings_of(set_, config, hold_out)
    given = [f"--{name}" for name, value in (("up", up), ("units", units), ("scene", scene)) if value != "auto"]
    given += ["--trajectory"] if trajectory is not None else []
    given += ["--classes-from-colours"] if classes_from_colours else []
    if given and not is_map(tile):
        raise SettingError(given[0], f"is for robots' maps, but {tile} is a tile", "Leave it out, or name a map")
    if is_map(tile):
        params = map_params(
            up=up, units=units, scene=scene, images=not no_images, classes_from_colours=classes_from_colours
        )
        tile = tile_of_map(tile, out, params, trajectory)
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
    check_own(out, RESULTS)
    with locked(out):
        watch = Watch([*source_files(tile.path), *source_paths(build_graph(tile, settings))])
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
            side.add(outcome.side_failed, outcome.done)
            done = outcome.of_tile()
            changed = publish(store, planned, done, out, tile, settings, side)
            with side.attempt("report", out / PAGE, out / DATA):
                seconds = time.perf_counter() - began
                report = write_report(tile, planned, done, store, out, seconds=seconds, failed=side.failed)
            log.write_failed(side)
        store.sweep({p.task.id.name: p.key for p in planned})
        for warning in changed:
            warn(warning)
        show_failed(side, log)
        lines = [*show_findings(done), *show_results(out / "world" / f"{tile.name}.sdf", report)]
        if not (changed or side.failed):
            watch.record(out, [*lines, "nothing to do: the world is up to date"])
    if missing == 0:
        console.print(f"[dim]nothing to do: the world is up to date ({time.perf_counter() - began:.1f} s)")
    side.check()
    assert report is not None, "side.check() raises if there is no report"
    return report
