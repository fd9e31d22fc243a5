"""`scan2sim plan`: lists the steps that `run` or `survey` would execute, why, and about how long they take."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from scan2sim.flows.commands.app import App, Config, Force, From, HoldOut, Sets, settings_of
from scan2sim.flows.commands.display import console
from scan2sim.flows.commands.robot_map import imported_tile
from scan2sim.flows.engine.estimate import Estimate, duration, estimates, summary, total
from scan2sim.flows.engine.planning import STORE, PlannedTask, check
from scan2sim.flows.engine.planning import plan as plan_nodes
from scan2sim.flows.pipelines.graph import TaskId
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.tile import build_graph
from scan2sim.pipeline.core.cache import Store
from scan2sim.pipeline.core.errors import ScanError, SettingError
from scan2sim.pipeline.core.types import Tile
from scan2sim.pipeline.io.tile import read_tile

app = App()
SURVEY, DRIVE = "survey.toml", "drive.toml"
SHOWN_CAUSES = 2
"""Causes listed for each tile of a survey."""


@app.command()
def plan(
    tile: Annotated[
        Path,
        typer.Argument(
            metavar="TILE", help="Tile, survey or drive: its folder, or its tile.toml, survey.toml or drive.toml."
        ),
    ],
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Output folder of the run, with the cached results that it would use.")
    ] = Path("out"),
    set_: Sets = None,
    config: Config = None,
    hold_out: HoldOut = None,
    force: Force = False,
    from_: From = None,
) -> None:
    """List the steps that `run` or `survey` with the same options would execute, why, and about how long they take."""
    show_plan(tile, out, settings_of(set_, config, hold_out), force=force, start=from_)


def show_plan(path: Path, out: Path, settings: Settings, *, force: bool = False, start: str | None = None) -> None:
    """Print for each step of a tile or a drive, or each tile of a survey, whether it would run, why, and its cost.

    Times are those of earlier runs.

    Raises:
        ScanError: see `pipeline.core.errors`; also if a step can't run on this machine.
    """
    drive = path / DRIVE if path.is_dir() else path
    survey = path / SURVEY if path.is_dir() else path
    if survey.name == SURVEY and survey.is_file():
        if force or start is not None:
            raise SettingError("--force, --from", "are for single tiles", "Leave them out")
        from scan2sim.flows.commands.survey import planned_survey  # imports Numba, as `drive` does

        planned, store, unread = planned_survey(survey, out, settings)
        check(planned)
        rows = estimates(planned, store)
        _show_tiles(rows, unread)
    else:
        if drive.name == DRIVE and drive.is_file():
            from scan2sim.flows.commands.drive import PREPARED, plan_drive

            planned, store, _ = plan_drive(drive, out / PREPARED)
        else:
            planned, store = plan_tile(read_tile(imported_tile(path, out)), out, settings, force, start)
        check(planned)
        rows = estimates(planned, store)
        _show_steps(rows)
    console.print(summary(rows), soft_wrap=True, highlight=False)


def _show_steps(rows: Sequence[Estimate]) -> None:
    table = Table("step", "would run", "why", "about", box=None, header_style="bold")
    for row in rows:
        about = duration(row.seconds) if row.runs else ""
        runs = "yes" if row.runs else "no"
        table.add_row(row.item.task.full_name, runs, row.why, about, style=None if row.runs else "dim")
    console.print(table)


def _show_tiles(rows: Sequence[Estimate], unread: Mapping[str, ScanError]) -> None:
    table = Table("tile", "runs", "runs if inputs really change", "why", box=None, header_style="bold")
    tiles: dict[str, list[Estimate]] = {}
    for row in rows:
        tiles.setdefault(row.item.task.tile, []).append(row)
    for name, own in tiles.items():
        certain, others = [row for row in own if row.certain], [row for row in own if row.runs and not row.certain]
        causes = dict.fromkeys(f"{row.item.task.id.name}: {row.why}" for row in certain)
        text = "; ".join(list(causes)[:SHOWN_CAUSES]) or ("its neighbours change" if others else "up to date")
        cost = [f"{len(some)} of {len(own)} steps, {total(some)}" if some else "" for some in (certain, others)]
        table.add_row(name, *cost, text, style=None if certain or others else "dim")
    for name, error in unread.items():
        table.add_row(name, "", "", f"can't be read: {error}", style="red")
    console.print(table)


def plan_tile(
    tile: Tile, out: Path, settings: Settings, force: bool, start: str | None, without: Collection[TaskId] = ()
) -> tuple[list[PlannedTask], Store]:
    """The plan of a tile, `without` side products that failed, and the cache of its results.

    Raises:
        SettingError: a setting is wrong, or there is no step `start`.
    """
    tasks = build_graph(tile, settings, without=without)
    names = {task.step.name for task in tasks}
    if start is not None and start not in names | {task.step for task in without}:
        raise SettingError(f"--from {start}", "there is no such step", f"Choose one of: {', '.join(sorted(names))}")
    store = Store(out / STORE)
    return plan_nodes(tasks, store, force=force, start=start), store
