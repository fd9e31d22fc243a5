"""`scan2sim plan`: what `run`, or what comes before `survey`'s tiles, would run, and why."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from rich.table import Table

from scan2sim.flows.commands.app import App, Config, Force, From, HoldOut, OutDir, Sets, TilePath, settings_of
from scan2sim.flows.commands.display import console
from scan2sim.flows.commands.drive import DRIVE, PREPARED, plan_drive
from scan2sim.flows.engine.planning import STORE, Planned, check
from scan2sim.flows.engine.planning import plan as plan_nodes
from scan2sim.flows.pipelines.graph import NodeId
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.tile import recipe
from scan2sim.pipeline.core.cache import Store
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.types import Tile
from scan2sim.pipeline.io.tile import read_tile

app = App()


@app.command()
def plan(
    tile: TilePath,
    out: OutDir = Path("out"),
    set_: Sets = None,
    config: Config = None,
    hold_out: HoldOut = None,
    force: Force = False,
    from_: From = None,
) -> None:
    """Show what `run` would run, and why; of a drive.toml, what `survey` would run before its tiles."""
    show_plan(tile, out, settings_of(set_, config, hold_out), force=force, start=from_)


def show_plan(path: Path, out: Path, settings: Settings, *, force: bool = False, start: str | None = None) -> None:
    """Print each step of the tile or drive, whether it would run, and why.

    Raises:
        ScanError: see `pipeline.core.errors`; also if a step couldn't run here.
    """
    drive = path / DRIVE if path.is_dir() else path
    if drive.name == DRIVE and drive.is_file():
        planned = plan_drive(drive, out / PREPARED)[0]
    else:
        planned = plan_tile(read_tile(path), out, settings, force, start)[0]
    check(planned)
    table = Table("step", "would run", "why", box=None, header_style="bold")
    for item in planned:
        runs, why = ("yes", item.reason.value) if item.reason else ("no", "kept: same input, settings and version")
        table.add_row(item.node.full_name, runs, why, style=None if item.reason else "dim")
    console.print(table)


def plan_tile(
    tile: Tile, out: Path, settings: Settings, force: bool, start: str | None, without: Collection[NodeId] = ()
) -> tuple[list[Planned], Store]:
    """What would run of a tile, without side products that failed, and the store that keeps its results.

    Raises:
        SettingError: as `recipe`; there is no step `start`.
    """
    nodes = recipe(tile, settings, without=without)
    names = {node.step.name for node in nodes}
    if start is not None and start not in names | {node.step for node in without}:
        raise SettingError(f"--from {start}", "there is no such step", f"Steps are: {', '.join(sorted(names))}")
    store = Store(out / STORE)
    return plan_nodes(nodes, store, force=force, start=start), store
