"""`scan2sim survey`: all tiles of a survey to worlds that meet, one world and one report, without Prefect."""

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
from scan2sim.flows.commands.run_with_progress import default_jobs, execute_shown, show_failed, show_results
from scan2sim.flows.engine import workers
from scan2sim.flows.engine.execution import Executor, limit_cores
from scan2sim.flows.engine.lock import locked
from scan2sim.flows.engine.memory import parse
from scan2sim.flows.engine.planning import STORE, Planned, Reason, drop_damaged, plan
from scan2sim.flows.engine.progress import published
from scan2sim.flows.engine.ready_queue import Outcome
from scan2sim.flows.engine.versions import versions
from scan2sim.flows.pipelines.graph import NodeId
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.survey import survey_recipe
from scan2sim.flows.pipelines.tile import check_here
from scan2sim.flows.reports.finish import TILES, Made, finish, is_finished
from scan2sim.flows.reports.publish import to_read
from scan2sim.flows.reports.side_products import SideProducts
from scan2sim.pipeline.core import system_libs
from scan2sim.pipeline.core.cache import Digests, Manifest, Store
from scan2sim.pipeline.core.errors import ScanError, SettingError, SpaceError, StepError
from scan2sim.pipeline.core.optional_deps import need
from scan2sim.pipeline.core.types import Tile
from scan2sim.pipeline.io.remote import Remote, is_remote, likeness
from scan2sim.pipeline.io.survey import Survey, read_survey
from scan2sim.pipeline.io.tile import read_tile

app = App()


@app.command()
def survey(
    context: typer.Context,
    source: Annotated[
        str, typer.Argument(metavar="SOURCE", help="A survey.toml, tile.toml or drive.toml, or its folder.")
    ],
    out: Annotated[
        str, typer.Option("--out", "-o", help="Folder for worlds, reports and kept results, or its s3:// URL.")
    ],
    length: Annotated[float | None, typer.Option(help="Metres of road a tile, where it is cut here.")] = None,
    buffer: Annotated[float | None, typer.Option(help="Metres of overlap, where it is cut here.")] = None,
    set_: Sets = None,
    config: Config = None,
    hold_out: HoldOut = None,
    jobs: Annotated[int, typer.Option(min=0, help="Steps at a time; 0: as the cores allow.")] = 0,
    memory: Annotated[str | None, typer.Option(help="What steps may need together, as 20GB.")] = None,
    runner: Annotated[
        Literal["processes", "threads", "dask", "ray"], typer.Option(help="The last three: through Prefect.")
    ] = "processes",
    address: Annotated[str | None, typer.Option(help="Of a Dask scheduler or Ray cluster.")] = None,
    cores: Annotated[int | None, typer.Option(min=1, help="That a step may use; default: all.")] = None,
    bus: Bus = None,
) -> None:
    """Make the worlds of all tiles of a survey, which meet, and one of them all."""
    run_source(
        source, out, settings_of(set_, config, hold_out), length=length, buffer=buffer, jobs=jobs, memory=memory,
        runner=runner, address=address, cores=cores, prefect=context.obj, bus=bus,
    )  # fmt: skip


def run_source(
    source: str, target: str, settings: Settings, *, length: float | None, buffer: float | None, jobs: int,
    memory: str | None, runner: str, address: str | None, cores: int | None, prefect: Callable[..., object],
    bus: str | None = None,
) -> None:  # fmt: skip
    """`scan2sim survey`: in processes of this machine, or through Prefect on a runner that is named.

    Args:
        source: a drive, a corridor or a survey (`commands.drive`).
        target: folder for all that is made; both may be in object storage.
        length, buffer: metres, of tiles that are cut here; default: as the drive says, or 100 and 5.
        jobs: steps at a time; 0: as the cores allow.
        memory: what steps may need together, "20GB".
        runner: "processes", or Prefect's "threads", "dask", "ray".
        address: of a Dask scheduler or a Ray cluster.
        cores: that a step may use.
        prefect: makes a survey as a flow of Prefect (`flows.cli`).
        bus: that is told how steps fare (`services.monitoring.export.event_publishers`).

    Raises:
        StepError: tiles failed; all others are finished.
        ScanError: see `pipeline.core.errors`; earlier results stay.
    """
    jobs, gigabytes = jobs or default_jobs(), parse(memory)
    if runner != "processes":
        need(f"--runner {runner}", "prefect")
        workers.check(runner)
        prefect(source, target, length, buffer, settings.values, runner, jobs, memory, cores, address, bus)
        return
    limit_cores(cores)
    system_libs.check()
    check_here(settings)
    log = Log(likeness(target) / "run.log")

    with published(bus, "survey", source) as on_bus:

        def run(planned: list[Planned], store: Store) -> Outcome:
            return execute_shown(planned, store, log, jobs, to_the_end=True, memory=gigabytes, bus=on_bus)

        path = survey_of(source, target, run, length=length, buffer=buffer, warn=warn)
        make_survey(path, target, settings, run)


def make_survey(place: str | Path, target: str | Path, settings: Settings, run: Executor) -> Path:
    """Make all worlds of the survey at `place` in the folder `target`; returns the report's path.

    Both may be in object storage (`pipeline.io.remote`); the report's path is that of its likeness here then.

    The folder gets `survey.html`, `survey.json`, `world/` (all tiles in one), `stac/`, `tiles/NAME/` (as `scan2sim run`
    writes it) and `steps/` (kept results). A tile that fails is reported; its neighbours are made as if it
    weren't there, and anew once it is.

    Raises:
        StepError: tiles failed; all others are finished.
        IncompleteError: side products failed; the world is finished.
        ScanError: see `pipeline.core.errors`; earlier results stay.
    """
    began = time.perf_counter()
    sources, results = _remote(place), _remote(target)
    survey = read_survey(sources.pull_all() if sources else Path(place))
    out = likeness(target)
    log, side = Log(out / "run.log"), SideProducts(out)
    with locked(out), log.errors(out):
        log.write(f"survey {survey.path}, settings {json.dumps(settings.values)}, versions {json.dumps(versions())}")
        store = _store(place, target)
        digests = Digests(store.root / "digests.json")
        made = _make(survey, settings, store, run, digests, side)
        report = finish(survey, made, store, out, settings, digests, side, warn)
        digests.save()
        log.write_failed(side)
        failed = [one for one in made if one.error is not None]
        for one in failed:
            log.write(f"{one.name}: failed: {one.error}")
        if results:
            files = (path.relative_to(out) for path in sorted(out.rglob("*")) if path.is_file())
            results.push_all(file.as_posix() for file in files if file.parts[0] not in (STORE, ".lock"))
    show_failed(side, log)
    kept = all(one.kept for one in made)
    show_results(out / "world" / f"{survey.name}.sdf", report)
    if kept and not failed and not side.failed:
        console.print(f"[dim]nothing to do: all is as the survey says ({time.perf_counter() - began:.1f} s)")
    if failed:
        first = failed[0].error
        raise StepError(
            report or out,
            f"{len(failed)} of {len(made)} tiles failed: {', '.join(one.name for one in failed)} ({first})",
            "Mend what the report names and run again: what is finished is kept",
        )
    side.check()
    assert report is not None, "without a report the check has raised"
    return report


def read_tiles(survey: Survey) -> tuple[dict[str, Tile], dict[str, ScanError]]:
    """The survey's tiles by name, and why others can't be read."""
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
    without: Collection[NodeId] = (),
) -> list[Planned]:
    """What would run of all tiles, without side products that failed, and why."""
    return plan(survey_recipe(list(tiles.values()), settings, without), store, digest=digest)


def _make(
    survey: Survey, settings: Settings, store: Store, run: Executor, digests: Digests, side: SideProducts
) -> list[Made]:
    """Run all tiles; again without tiles and side products that fail, until none does."""
    out = side.out
    tiles, failed = read_tiles(survey)
    unread = set(failed)
    side_failed: dict[NodeId, ScanError] = {}
    ran: dict[tuple[NodeId, str], Reason] = {}  # why, of what an earlier round of this run has made
    before: dict[NodeId, set[str]] = {}  # what there was, of all that is run
    first = plan_survey(tiles, store, settings, digests)
    for name in tiles:
        own = [item for item in first if item.node.tile == name]
        if not is_finished(store.within(name), own, out / TILES / name):
            drop_damaged(own, store, to_read(store.within(name), own, out / TILES / name))
    while True:
        planned = plan_survey(tiles, store, settings, digests, side_failed)
        planned = [replace(item, reason=item.reason or ran.get((item.node.id, item.key))) for item in planned]
        ran |= {(item.node.id, item.key): item.reason for item in planned if item.reason is not None}
        for node in {item.node.id for item in planned if item.reason is not None} - before.keys():
            before[node] = store.contents(node.full_name)
        outcome = run(planned, store)
        for error in outcome.failed.values():
            if isinstance(error, (SpaceError, SettingError)):  # no tile's fault
                raise error
        side_failed |= outcome.side_failed
        if not (outcome.failed or outcome.side_failed):
            break
        for node, error in outcome.failed.items():
            failed.setdefault(node.tile, error)
        tiles = {name: tile for name, tile in tiles.items() if name not in failed}
    side.add({node: error for node, error in side_failed.items() if node.tile in tiles})
    return [
        Made(name, None if name in unread else read_tile(path), error=failed[name])
        if name in failed
        else Made(name, tiles[name], *_of_tile(name, planned, outcome, before))
        for name, path in survey.tiles.items()
    ]


def _of_tile(
    name: str, planned: Sequence[Planned], outcome: Outcome, before: Mapping[NodeId, set[str]]
) -> tuple[tuple[Planned, ...], dict[str, Manifest], bool]:
    """A tile's own nodes, and results by their names within it; whether any isn't as `before`."""
    own = tuple(item for item in planned if item.node.tile == name)
    ran = before.keys() & {item.node.id for item in own}
    return own, outcome.of_tile(name), any(outcome.done[node].content not in before[node] for node in ran)


def changes(place: str | Path, target: str | Path, settings: Settings) -> dict[str, str]:
    """Why each tile of a survey would run, by name; empty where all is as it was.

    Raises:
        ScanError: see `pipeline.core.errors`.
    """
    sources, store = _remote(place), _store(place, target)
    digests = Digests(store.root / "digests.json")
    tiles, failed = read_tiles(read_survey(sources.pull_all() if sources else Path(place)))
    found = {name: str(error) for name, error in failed.items()}
    for item in plan_survey(tiles, store, settings, digests):
        if item.reason is not None:
            found.setdefault(item.node.tile, f"{item.node.step.name}: {item.reason.value}")
    return found


def _remote(place: str | Path) -> Remote | None:
    return Remote.of(str(place)) if is_remote(place) else None


def _store(place: str | Path, target: str | Path) -> Store:
    results = _remote(target)
    return Store(likeness(target) / STORE, results and results.below(STORE), _remote(place))
