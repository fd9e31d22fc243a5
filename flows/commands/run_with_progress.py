"""A plan that is run, and what came of it, on the screen."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Mapping
from pathlib import Path

from scan2sim.flows.commands.display import RunDisplay, console, warn
from scan2sim.flows.commands.log import Log
from scan2sim.flows.engine.execution import execute
from scan2sim.flows.engine.planning import Planned, drop_damaged, plan
from scan2sim.flows.engine.progress import PublishedRun
from scan2sim.flows.engine.ready_queue import Event, Outcome, unwatched
from scan2sim.flows.pipelines.graph import Node
from scan2sim.flows.reports import gazebo
from scan2sim.flows.reports.findings import findings
from scan2sim.flows.reports.side_products import SideProducts
from scan2sim.pipeline.core.cache import Manifest, Store, digest

WORST = 3
"""Findings that are shown on the screen."""


def execute_shown(
    planned: list[Planned],
    store: Store,
    log: Log,
    jobs: int = 0,
    to_the_end: bool = False,
    memory: float | None = None,
    bus: PublishedRun | None = None,
) -> Outcome:
    """`execute`, with bars on the screen and lines in the log; the bus is told, too."""
    told = bus.steps.watching(planned, store) if bus else unwatched
    with RunDisplay(len(planned)) as display:

        def watch(node: Node, event: Event, fraction: float, message: str) -> None:
            display.watch(node, event, fraction, message)
            told(node, event, fraction, message)
            if event != "progress":
                log.write(f"{node.full_name}: {event}{': ' if message else ''}{message}")

        jobs = jobs or default_jobs()
        outcome = execute(planned, store, jobs=jobs, watch=watch, to_the_end=to_the_end, memory=memory)
    for node, manifest in outcome.done.items():
        lines = [manifest.facts["told"]] if "told" in manifest.facts else []
        for line in lines + [f"warning: {text}" for text in manifest.warnings]:
            log.write(f"{node}: {line}")
    return outcome


def run_shown(
    nodes: list[Node],
    store: Store,
    log: Log,
    checked: Collection[str],
    digest: Callable[[Path], str] = digest,
    bus: PublishedRun | None = None,
) -> tuple[list[Planned], dict[str, Manifest]]:
    """Plan nodes and run them, as `execute_shown`; what is damaged of the results of those `checked` is made again.

    Args:
        nodes: of one tile.
        store: that keeps their results.
        log: for what runs.
        checked: names of nodes whose results will be read.
        digest: of a source file.
        bus: that is told of it.

    Returns:
        The plan, and results by the nodes' labels.

    Raises:
        ScanError: see `pipeline.core.errors`; earlier results stay.
    """
    planned = plan(nodes, store, digest=digest)
    if drop_damaged(planned, store, checked):
        planned = plan(nodes, store, digest=digest)
    outcome = execute_shown(planned, store, log, bus=bus)
    outcome.check()
    return planned, outcome.of_tile()


def show_results(world: Path, report: Path | None) -> None:
    """Where the world and the report are, and how to open them, on the screen."""
    lines = [*gazebo.lines(world), *([f"Report: {report}"] if report else [])]
    console.print("\n".join(lines), highlight=False, soft_wrap=True, markup=False)


def show_findings(done: Mapping[str, Manifest]) -> None:
    """The worst of what is wrong with the world, on the screen; the report has all of it."""
    found = findings(done)
    if found and found[0].level == "unusable":
        console.print("[bold red]This world can't be used as it is:[/]")
    for one in found[:WORST]:
        warn(f"{one.about}: {one.text}")
    if len(found) > WORST:
        console.print(f"[dim]{len(found) - WORST} more in the report")


def show_failed(side: SideProducts, log: Log) -> None:
    """The side products that failed, a line each, on the screen."""
    for text in side.warnings():
        warn(f"{text} (details: {log.path})")


def show_warnings(done: Mapping[str, Manifest]) -> None:
    """What the steps warned of, on the screen."""
    for node, manifest in done.items():
        for warning in manifest.warnings:
            warn(f"{node}: {warning}")


def default_jobs() -> int:
    """Steps at a time: two, three where there are six cores or more (there are three classes)."""
    return 3 if (os.cpu_count() or 1) >= 6 else 2
