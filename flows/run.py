"""`scan2sim run` and `plan`: a tile to a world and its report, in processes, without Prefect."""

from __future__ import annotations

import json
import os
import shutil
import time
import traceback
from pathlib import Path

from flows.display import RunDisplay, console
from flows.execute import Planned, execute, locked, plan, versions
from flows.recipe import recipe
from flows.report import write_report
from flows.settings import Settings
from pipeline.errors import ScanError, SettingError, from_os_error
from pipeline.io.tile import read_tile
from pipeline.store import Manifest, Store
from pipeline.types import Tile

STORE = "steps"


def run_tile(
    path: Path, out: Path, settings: Settings, *, force: bool = False, start: str | None = None, jobs: int = 0
) -> Path:
    """Make the world of the tile at `path` in `out`; returns the report's path.

    `out` gets: `world/`, `report.html`, `report.json`, `config.json` (all settings as resolved),
    `run.log`, and `steps/` (kept results).

    Raises:
        ScanError: see `pipeline.errors`; earlier results stay.
    """
    began = time.perf_counter()
    with locked(out):
        tile, planned, store = _plan(path, out, settings, force, start)
        missing = sum(p.reason is not None for p in planned)
        try:
            with RunDisplay(len(planned)) as display:
                done = execute(planned, store, jobs=jobs or default_jobs(), watch=display.watch)
            _publish(store, planned, done, out, tile, settings)
            report = write_report(tile, planned, done, store, out, seconds=time.perf_counter() - began)
        except ScanError as error:
            _log(out, error)
            raise
        except OSError as error:
            raise from_os_error(error, out) from error
        store.sweep({p.node.label: p.key for p in planned})
    for label, manifest in done.items():
        for warning in manifest.warnings:
            console.print(f"[yellow]warning:[/] {label}: {warning}", highlight=False)
    console.print(f"World:  {out / 'world'}\nReport: {report}", highlight=False, soft_wrap=True)
    if missing == 0:
        console.print(
            f"[dim]nothing to do: all is as the tile and the settings say ({time.perf_counter() - began:.1f} s)"
        )
    return report


def show_plan(path: Path, out: Path, settings: Settings, *, force: bool = False, start: str | None = None) -> None:
    """Print each step of the tile, whether it would run, and why."""
    from rich.table import Table

    _, planned, _ = _plan(path, out, settings, force, start)
    table = Table("step", "would run", "why", box=None, header_style="bold")
    for item in planned:
        runs, why = ("yes", item.reason) if item.reason else ("no", "kept: same input, settings and version")
        table.add_row(item.node.label, runs, why, style=None if item.reason else "dim")
    console.print(table)


def default_jobs() -> int:
    """Steps at a time: two, three where there are six cores or more (there are three classes)."""
    return 3 if (os.cpu_count() or 1) >= 6 else 2


def _plan(
    path: Path, out: Path, settings: Settings, force: bool, start: str | None
) -> tuple[Tile, list[Planned], Store]:
    tile = read_tile(path)
    nodes = recipe(tile, settings)
    names = {node.step.name for node in nodes}
    if start is not None and start not in names:
        raise SettingError(f"--from {start}", "there is no such step", f"Steps are: {', '.join(sorted(names))}")
    store = Store(out / STORE)
    return tile, plan(nodes, store, force=force, start=start), store


def _publish(
    store: Store, planned: list[Planned], done: dict[str, Manifest], out: Path, tile: Tile, settings: Settings
) -> None:
    """Put the world beside the report, as hard links into the store where the file system allows."""
    keys = {p.node.label: p.key for p in planned}
    source = store.folder("export", keys["export"]) / done["export"].files["world"]
    fresh = out / ".world"
    shutil.rmtree(fresh, ignore_errors=True)
    shutil.copytree(source, fresh, copy_function=_link)
    shutil.rmtree(out / "world", ignore_errors=True)
    fresh.rename(out / "world")
    config = {
        "tile": str(tile.path),
        "versions": versions(),
        "set": settings.values,
        "steps": {
            p.node.label: done[p.node.label].params for p in planned if p.node.step.name not in ("views", "path")
        },
    }
    (out / "config.json").write_text(json.dumps(config, indent=1), encoding="utf-8")


def _link(source: str, target: str) -> None:
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def _log(out: Path, error: ScanError) -> None:
    with open(out / "run.log", "a", encoding="utf-8") as file:
        file.write(f"{time.strftime('%Y-%m-%d %H:%M:%S')} {error}\n")
        file.writelines(getattr(error, "__notes__", traceback.format_exception(error)))
