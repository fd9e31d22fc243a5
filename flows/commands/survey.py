"""`scan2sim survey`: builds all tiles of a survey with matching borders, one world and one report, without Prefect."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import typer

from scan2sim.flows.commands.app import App, Bus, Config, HoldOut, Sets, settings_of
from scan2sim.flows.commands.display import console, warn
from scan2sim.flows.commands.drive import survey_of
from scan2sim.flows.commands.log import Log
from scan2sim.flows.commands.run_with_progress import default_jobs, execute_with_progress, show_failed, show_results
from scan2sim.flows.commands.unchanged import Watch
from scan2sim.flows.engine import workers
from scan2sim.flows.engine.execution import Executor, limit_cores
from scan2sim.flows.engine.lock import locked
from scan2sim.flows.engine.memory import parse_memory
from scan2sim.flows.engine.output_folder import check_own
from scan2sim.flows.engine.planning import STORE, PlannedTask, Reason, collector_paused, drop_damaged, plan
from scan2sim.flows.engine.progress import published
from scan2sim.flows.engine.ready_queue import Outcome
from scan2sim.flows.engine.versions import versions
from scan2sim.flows.pipelines.graph import TaskId, source_paths
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.survey import build_survey_graph
from scan2sim.flows.pipelines.tile import check_here
from scan2sim.flows.reports.finish import TILES, TileResult, finish, is_finished
from scan2sim.flows.reports.publish import to_read
from scan2sim.flows.reports.side_products import SideProducts
from scan2sim.pipeline.core import system_libs
from scan2sim.pipeline.core.cache import Digests, Manifest, Store
from scan2sim.pipeline.core.errors import ScanError, SettingError, SpaceError, StepError, WorkerError
from scan2sim.pipeline.core.optional_deps import require
from scan2sim.pipeline.core.remote import Remote, is_remote, local_copy
from scan2sim.pipeline.core.types import Tile
from scan2sim.pipeline.io.survey import Survey, read_survey
from scan2sim.pipeline.io.tile import read_tile, source_files

app = App()
SURVEY_RESULTS = ("world", "stac", "survey.html", "survey.json")
"""Files and folders that a survey writes into its output folder, beside those of its tiles."""


@app.command()
def survey(
    context: typer.Context,
    source: Annotated[
        str,
        typer.Argument(
            metavar="SOURCE", help="A survey.toml, a tile.toml to cut into tiles, a drive.toml, or its folder."
        ),
    ],
    out: Annotated[
        str, typer.Option("--out", "-o", help="Output folder, or its s3:// URL: worlds, reports and cached results.")
    ],
    length: Annotated[
        float | None, typer.Option(help="Length of road per tile in metres, if SOURCE is to be cut; default: 100.")
    ] = None,
    buffer: Annotated[
        float | None,
        typer.Option(
            help="Margin in metres by which tiles overlap their neighbours, if SOURCE is to be cut; default: 5."
        ),
    ] = None,
    set_: Sets = None,
    config: Config = None,
    hold_out: HoldOut = None,
    jobs: Annotated[
        int,
        typer.Option(
            min=0,
            help="Steps that run at the same time; 0: one for every two cores, as free memory allows; "
            "with --address, as many as its workers.",
        ),
    ] = 0,
    memory: Annotated[
        str | None, typer.Option(help="Memory that all running steps may use together, such as 20GB.")
    ] = None,
    runner: Annotated[
        Literal["processes", "threads", "dask", "ray"],
        typer.Option(help="Where steps run: local processes, or as a Prefect flow on threads, Dask or Ray."),
    ] = "processes",
    address: Annotated[
        str | None, typer.Option(help="Address of a Dask scheduler or Ray cluster; default: start one here.")
    ] = None,
    cores: Annotated[int | None, typer.Option(min=1, help="CPU cores that each step may use; default: all.")] = None,
    bus: Bus = None,
) -> None:
    """Build the worlds of all tiles of a survey, with matching borders, and one world of them all."""
    settings = settings_of(set_, config, hold_out)
    if runner == "processes":
        run_source(source, out, settings, length=length, buffer=buffer, jobs=jobs, memory=memory, cores=cores, bus=bus)
    else:
        require(f"--runner {runner}", "prefect")
        workers.check(runner)
        as_flow: Callable[..., object] = context.obj
        jobs = jobs or (0 if address and runner != "threads" else default_jobs())
        as_flow(source, out, length, buffer, settings.values, runner, jobs, memory, cores, address, bus)


def run_source(
    source: str,
    target: str,
    settings: Settings,
    *,
    length: float | None = None,
    buffer: float | None = None,
    jobs: int = 0,
    memory: str | None = None,
    cores: int | None = None,
    bus: str | None = None,
) -> Path:
    """Build a survey in processes of this machine, and its tiles before that where the source is not cut yet.

    Args:
        source: a drive, a corridor or a survey (`commands.drive`).
        target: output folder; source and target may be URLs of object storage.
        settings: of all steps.
        length, buffer: tile length and overlap in metres if the source is cut; default: of the drive, or 100 and 5.
        jobs: steps at a time; 0: one for every two cores, as free memory allows.
        memory: limit of the memory of all running steps, "20GB".
        cores: CPU cores per step.
        bus: where progress is published (`services.monitoring.events.event_publishers`).

    Returns:
        The path of the report.

    Raises:
        StepError: tiles failed; all others are finished.
        ScanError: see `pipeline.core.errors`; results of earlier runs stay.
    """
    gigabytes = parse_memory(memory)
    limit_cores(cores)
    system_libs.check()
    check_here(settings)
    log = Log(local_copy(target) / "run.log")

    with published(bus, "survey", source) as on_bus:

        def run(planned: list[PlannedTask], store: Store) -> Outcome:
            return execute_with_progress(planned, store, log, jobs, keep_going=True, memory=gigabytes, bus=on_bus)

        path = survey_of(source, target, run, length=length, buffer=buffer, warn=warn)
        return make_survey(path, target, settings, run)


def make_survey(place: str | Path, target: str | Path, settings: Settings, run: Executor) -> Path:
    """Build all worlds of the survey at `place` in the folder `target`; returns the report's path.

    Both may be in object storage (`pipeline.core.remote`); the returned path is then that of the local copy.

    The folder gets `survey.html`, `survey.json`, `world/` (all tiles in one), `stac/`, `tiles/NAME/` (as `scan2sim run`
    writes it) and `steps/` (cached results). A tile that fails is reported; its neighbours are built as if it did not
    exist, and rebuilt once it succeeds.

    Raises:
        StepError: tiles failed; all others are finished.
        IncompleteError: the world is finished, but side products failed.
        ScanError: see `pipeline.core.errors`; results of earlier runs stay.
    """
    began = time.perf_counter()
    remote_source, remote_target = _remote(place), _remote(target)
    survey = read_survey(remote_source.pull_all() if remote_source else Path(place))
    out = local_copy(target)
    log, side = Log(out / "run.log"), SideProducts(out)
    check_own(out, SURVEY_RESULTS)
    with locked(out), log.errors(out):
        log.write(f"survey {survey.path}, settings {json.dumps(settings.values)}, versions {json.dumps(versions())}")
        store = _store(place, target)
        digests = Digests(store.root / "digests.json")
        tiles, unread = read_tiles(survey)
        watch = _watch(survey, tiles, settings)
        tile_results = _run_tiles(survey, tiles, unread, settings, store, run, digests, side)
        warnings: list[str] = []
        report = finish(survey, tile_results, store, out, settings, digests, side, warnings.append)
        for text in warnings:
            warn(text)
        digests.save()
        log.write_failed(side)
        failed = [result for result in tile_results if result.error is not None]
        for result in failed:
            log.write(f"{result.name}: failed: {result.error}")
        if remote_target:
            files = (path.relative_to(out) for path in sorted(out.rglob("*")) if path.is_file())
            remote_target.push_all(file.as_posix() for file in files if file.parts[0] not in (STORE, ".lock"))
        show_failed(side, log)
        lines = show_results(out / "world" / f"{survey.name}.sdf", report)
        made_here = remote_source or remote_target or survey.path.resolve().is_relative_to(out.resolve())
        if not (made_here or failed or side.failed or warnings):
            watch.record(out, [*lines, "nothing to do: all worlds are up to date"])
    up_to_date = all(result.up_to_date for result in tile_results)
    if up_to_date and not failed and not side.failed:
        console.print(f"[dim]nothing to do: all worlds are up to date ({time.perf_counter() - began:.1f} s)")
    if failed:
        names, first_error = ", ".join(result.name for result in failed), failed[0].error
        raise StepError(
            report or out,
            f"{len(failed)} of {len(tile_results)} tiles failed: {names} ({first_error})",
            "Fix what the report names and run again: finished steps are not repeated",
        )
    side.check()
    assert report is not None, "side.check() raises if there is no report"
    return report


def _watch(survey: Survey, tiles: Mapping[str, Tile], settings: Settings) -> Watch:
    """The status of all files that the tiles are made from."""
    tasks = build_survey_graph(list(tiles.values()), settings)
    return Watch([survey.path, *source_paths(tasks), *(file for t in tiles.values() for file in source_files(t.path))])


def read_tiles(survey: Survey) -> tuple[dict[str, Tile], dict[str, ScanError]]:
    """The survey's tiles by name, and the errors of those that can't be read."""
    tiles: dict[str, Tile] = {}
    failed: dict[str, ScanError] = {}
    for name, path in survey.tiles.items():
        try:
            tiles[name] = read_tile(path)
        except ScanError as error:
            failed[name] = error
    return tiles, failed


def plan_survey(
    tiles: Mapping[str, Tile],
    store: Store,
    settings: Settings,
    digest: Callable[[Path], str],
    without: Collection[TaskId] = (),
) -> list[PlannedTask]:
    """The plan of all tiles, `without` side products that failed."""
    with collector_paused():
        return plan(build_survey_graph(list(tiles.values()), settings, without), store, digest=digest)


def _run_tiles(
    survey: Survey,
    tiles: dict[str, Tile],
    unread: Mapping[str, ScanError],
    settings: Settings,
    store: Store,
    run: Executor,
    digests: Digests,
    side: SideProducts,
) -> list[TileResult]:
    """Run all tiles; repeat without the tiles and side products that failed, until none fails."""
    out, failed = side.out, dict(unread)
    side_failed: dict[TaskId, ScanError] = {}
    ran: dict[tuple[TaskId, str], Reason] = {}  # reasons of tasks that an earlier round of this run executed
    before: dict[TaskId, set[str]] = {}  # contents of the results that existed before each task ran
    planned = plan_survey(tiles, store, settings, digests)
    damaged = False
    for name, own_tasks in _by_tile(planned).items():
        if not is_finished(store.within(name), own_tasks, out / TILES / name):
            read = to_read(store.within(name), own_tasks, out / TILES / name)
            damaged |= drop_damaged(own_tasks, store, read)
    again = damaged  # planning takes minutes for a thousand tiles on a network drive
    while True:
        planned = plan_survey(tiles, store, settings, digests, side_failed) if again else planned
        again = True
        planned = [replace(item, reason=item.reason or ran.get((item.task.id, item.key))) for item in planned]
        ran |= {(item.task.id, item.key): item.reason for item in planned if item.reason is not None}
        for task in {item.task.id for item in planned if item.reason is not None} - before.keys():
            before[task] = store.contents(task.full_name)
        outcome = run(planned, store)
        for error in outcome.failed.values():
            if isinstance(error, (SpaceError, SettingError, WorkerError)):  # not the fault of a single tile
                raise error
        side_failed |= outcome.side_failed
        if not (outcome.failed or outcome.side_failed):
            break
        for task, error in outcome.failed.items():
            failed.setdefault(task.tile, error)
        tiles = {name: tile for name, tile in tiles.items() if name not in failed}
    side.add({task: error for task, error in side_failed.items() if task.tile in tiles}, outcome.done)
    by_tile = _by_tile(planned)
    return [
        TileResult(name, None if name in unread else read_tile(path), error=failed[name])
        if name in failed
        else TileResult(name, tiles[name], *_tile_result_parts(name, by_tile.get(name, []), outcome, before))
        for name, path in survey.tiles.items()
    ]


def _by_tile(planned: Sequence[PlannedTask]) -> dict[str, list[PlannedTask]]:
    """The tasks of each tile, in the plan's order."""
    found: dict[str, list[PlannedTask]] = {}
    for item in planned:
        found.setdefault(item.task.tile, []).append(item)
    return found


def _tile_result_parts(
    name: str, planned: Sequence[PlannedTask], outcome: Outcome, before: Mapping[TaskId, set[str]]
) -> tuple[tuple[PlannedTask, ...], dict[str, Manifest], bool]:
    """A tile's planned tasks, their results by name within it, and whether any result differs from `before`."""
    own_tasks = tuple(planned)
    ran = before.keys() & {item.task.id for item in own_tasks}
    return own_tasks, outcome.of_tile(name), any(outcome.done[task].content not in before[task] for task in ran)


def planned_survey(
    place: str | Path, target: str | Path, settings: Settings
) -> tuple[list[PlannedTask], Store, dict[str, ScanError]]:
    """The plan of a survey, the cache of its results, and the errors of tiles that can't be read.

    Raises:
        ScanError: see `pipeline.core.errors`.
    """
    remote_source, store = _remote(place), _store(place, target)
    digests = Digests(store.root / "digests.json")
    tiles, failed = read_tiles(read_survey(remote_source.pull_all() if remote_source else Path(place)))
    return plan_survey(tiles, store, settings, digests), store, failed


def changes(place: str | Path, target: str | Path, settings: Settings) -> dict[str, str]:
    """Reasons why tiles of a survey would be rebuilt, by tile name; empty if all are up to date.

    Raises:
        ScanError: see `pipeline.core.errors`.
    """
    planned, _, failed = planned_survey(place, target, settings)
    reasons = {name: str(error) for name, error in failed.items()}
    for item in planned:
        if item.reason is not None:
            reasons.setdefault(item.task.tile, f"{item.task.step.name}: {item.reason.value}")
    return reasons


def _remote(place: str | Path) -> Remote | None:
    return Remote.of(str(place)) if is_remote(place) else None


def _store(place: str | Path, target: str | Path) -> Store:
    results = _remote(target)
    return Store(local_copy(target) / STORE, results and results.below(STORE), _remote(place))
