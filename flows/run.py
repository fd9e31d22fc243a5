"""`scan2sim run` and `plan`: a tile to a world and its report, in processes, without Prefect."""

from __future__ import annotations

import json
import os
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from scan2sim.flows import gazebo
from scan2sim.flows.display import RunDisplay, console, warn
from scan2sim.flows.execute import Event, Executor, Outcome, execute, locked, versions
from scan2sim.flows.findings import findings
from scan2sim.flows.graph import Node
from scan2sim.flows.planning import Planned, check, drop_damaged, plan
from scan2sim.flows.publish import publish, to_read
from scan2sim.flows.recipe import recipe
from scan2sim.flows.report import write_report
from scan2sim.flows.settings import Settings
from scan2sim.pipeline.errors import ScanError, SettingError, from_os_error
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.store import Manifest, Store
from scan2sim.pipeline.types import Tile

STORE = "steps"
WORST = 3
"""Findings that are shown on the screen."""


def run_tile(
    path: Path,
    out: Path,
    settings: Settings,
    *,
    force: bool = False,
    start: str | None = None,
    jobs: int = 0,
    run: Executor | None = None,
) -> Path:
    """Make the world of the tile at `path` in `out`; returns the report's path.

    `out` gets: `world/`, `report.html`, `report.json`, `config.json` (all settings as resolved),
    `run.log`, and `steps/` (kept results).

    Args:
        run: runs the steps; by default up to `jobs` processes at a time.

    Raises:
        ScanError: see `pipeline.errors`; earlier results stay.
    """
    began = time.perf_counter()
    tile = read_tile(path)
    with locked(out):
        planned, store = _plan(tile, out, settings, force, start)
        if drop_damaged(planned, store, to_read(store, planned, out)):
            planned, store = _plan(tile, out, settings, force, start)
        log = Log(out / "run.log")
        log.write(f"tile {tile.path}, settings {json.dumps(settings.values)}, versions {json.dumps(versions())}")
        missing = sum(p.reason is not None for p in planned)
        with log.errors(out):
            outcome = run(planned, store) if run else execute_shown(planned, store, log, jobs)
            outcome.check()
            done = outcome.of_tile()
            changed = publish(store, planned, done, out, tile, settings)
            report = write_report(tile, planned, done, store, out, seconds=time.perf_counter() - began)
        store.sweep({p.node.id.name: p.key for p in planned})
    for warning in changed:
        warn(warning)
    show_findings(done)
    show_results(out / "world" / f"{tile.name}.sdf", report)
    if missing == 0:
        console.print(
            f"[dim]nothing to do: all is as the tile and the settings say ({time.perf_counter() - began:.1f} s)"
        )
    return report


def execute_shown(
    planned: list[Planned],
    store: Store,
    log: Log,
    jobs: int = 0,
    to_the_end: bool = False,
    memory: float | None = None,
) -> Outcome:
    """`execute`, with bars on the screen and lines in the log."""
    with RunDisplay(len(planned)) as display:

        def watch(node: Node, event: Event, fraction: float, message: str) -> None:
            display.watch(node, event, fraction, message)
            if event != "progress":
                log.write(f"{node.label}: {event}{': ' if message else ''}{message}")

        jobs = jobs or default_jobs()
        outcome = execute(planned, store, jobs=jobs, watch=watch, to_the_end=to_the_end, memory=memory)
    for node, manifest in outcome.done.items():
        told = [manifest.facts["told"]] if "told" in manifest.facts else []
        for line in told + [f"warning: {text}" for text in manifest.warnings]:
            log.write(f"{node}: {line}")
    return outcome


def show_results(world: Path, report: Path) -> None:
    """Where the world and the report are, and how to open them, on the screen."""
    told = [*gazebo.lines(world), f"Report: {report}"]
    console.print("\n".join(told), highlight=False, soft_wrap=True, markup=False)


def show_findings(done: dict[str, Manifest]) -> None:
    """The worst of what is wrong with the world, on the screen; the report has all of it."""
    found = findings(done)
    if found and found[0].level == "unusable":
        console.print("[bold red]This world can't be used as it is:[/]")
    for one in found[:WORST]:
        warn(f"{one.about}: {one.text}")
    if len(found) > WORST:
        console.print(f"[dim]{len(found) - WORST} more in the report")


def show_warnings(done: dict[str, Manifest]) -> None:
    """What the steps warned of, on the screen."""
    for label, manifest in done.items():
        for warning in manifest.warnings:
            warn(f"{label}: {warning}")


def show_plan(path: Path, out: Path, settings: Settings, *, force: bool = False, start: str | None = None) -> None:
    """Print each step of the tile, whether it would run, and why.

    Raises:
        ScanError: see `pipeline.errors`; also if a step couldn't run here.
    """
    from rich.table import Table

    planned, _ = _plan(read_tile(path), out, settings, force, start)
    check(planned)
    table = Table("step", "would run", "why", box=None, header_style="bold")
    for item in planned:
        runs, why = ("yes", item.reason.value) if item.reason else ("no", "kept: same input, settings and version")
        table.add_row(item.node.label, runs, why, style=None if item.reason else "dim")
    console.print(table)


def default_jobs() -> int:
    """Steps at a time: two, three where there are six cores or more (there are three classes)."""
    return 3 if (os.cpu_count() or 1) >= 6 else 2


def _plan(tile: Tile, out: Path, settings: Settings, force: bool, start: str | None) -> tuple[list[Planned], Store]:
    nodes = recipe(tile, settings)
    names = {node.step.name for node in nodes}
    if start is not None and start not in names:
        raise SettingError(f"--from {start}", "there is no such step", f"Steps are: {', '.join(sorted(names))}")
    store = Store(out / STORE)
    return plan(nodes, store, force=force, start=start), store


class Log:
    """`run.log`: what was asked for, what ran when, what steps told, and the details of errors."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def write(self, *lines: str) -> None:
        """Append lines, the first with the time."""
        with open(self.path, "a", encoding="utf-8") as file:
            file.write(f"{time.strftime('%Y-%m-%d %H:%M:%S')} " + "".join(f"{line.rstrip()}\n" for line in lines))

    @contextmanager
    def errors(self, out: Path) -> Iterator[None]:
        """Write down what goes wrong within, and pass it on; an error of the system becomes one of ours about `out`."""
        try:
            yield
        except ScanError as error:
            self.write(f"error: {error}", *getattr(error, "__notes__", traceback.format_exception(error)))
            raise
        except OSError as error:
            raise from_os_error(error, out) from error
