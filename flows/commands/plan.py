"""`scan2sim plan`: lists the steps that `run`, or `survey` before its tiles, would execute, and why."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from scan2sim.flows.commands.app import App, Config, Force, From, HoldOut, Sets, TilePath, settings_of
from scan2sim.flows.commands.display import console
from scan2sim.flows.commands.drive import DRIVE, PREPARED, plan_drive
from scan2sim.flows.engine.planning import STORE, PlannedTask, check
from scan2sim.flows.engine.planning import plan as plan_nodes
from scan2sim.flows.pipelines.graph import TaskId
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.tile import build_graph
from scan2sim.pipeline.core.cache import Store
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.types import Tile
from scan2sim.pipeline.io.tile import read_tile

app = App()


@app.command()
def plan(
    tile: TilePath,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Output folder of the run, with the cached results that it would use.")
    ] = Path("out"),
    set_: Sets = None,
    config: Config = None,
    hold_out: HoldOut = None,
    force: Force = False,
    from_: From = None,
) -> None:
    """List the steps that `run` would execute, and why (for a drive.toml: `survey`, before its tiles)."""
    show_plan(tile, out, settings_of(set_, config, hold_out), force=force, start=from_)


def show_plan(path: Path, out: Path, settings: Settings, *, force: bool = False, start: str | None = None) -> None:
    """Print for each step of a tile or a drive whether it would run, and why.

    Raises:
        ScanError: see `pipeline.core.errors`; also if a step can't run on this machine.
    """
    drive = path / DRIVE if path.is_dir() else path
    if drive.name == DRIVE and drive.is_file():
        planned = plan_drive(drive, out / PREPARED)[0]
    else:
        planned = plan_tile(read_tile(path), out, settings, force, start)[0]
    check(planned)
    table = Table("step", "would run", "why", box=None, header_style="bold")
    for item in planned:
        runs, why = ("yes", item.reason.value) if item.reason else ("no", "cached: same input, settings and version")
        table.add_row(item.task.full_name, runs, why, style=None if item.reason else "dim")
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
