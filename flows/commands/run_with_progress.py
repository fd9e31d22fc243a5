"""Runs a plan with progress bars, and prints its results, findings and warnings."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from pathlib import Path

from scan2sim.flows.commands.display import RunDisplay, console, warn
from scan2sim.flows.commands.log import Log
from scan2sim.flows.engine.execution import execute
from scan2sim.flows.engine.memory import free_memory
from scan2sim.flows.engine.planning import PlannedTask, drop_damaged, plan
from scan2sim.flows.engine.progress import PublishedRun
from scan2sim.flows.engine.ready_queue import Event, Outcome, ignore_event
from scan2sim.flows.pipelines.graph import Task
from scan2sim.flows.reports import gazebo
from scan2sim.flows.reports.findings import findings
from scan2sim.flows.reports.side_products import SideProducts
from scan2sim.pipeline.core.cache import Manifest, Store, digest
from scan2sim.pipeline.core.cores import available_cores

MAX_FINDINGS = 3
"""Findings printed at the end of a run; the report has all."""


def execute_with_progress(
    planned: list[PlannedTask],
    store: Store,
    log: Log,
    jobs: int = 0,
    keep_going: bool = False,
    memory: float | None = None,
    bus: PublishedRun | None = None,
) -> Outcome:
    """Run a plan by `execute`, with progress bars and log entries; published by the `bus`.

    Args:
        planned: the plan.
        store: cache of the results.
        log: receives events, warnings and summaries.
        jobs: steps at a time; 0: by the number of cores (`default_jobs`), as far as free memory allows.
        keep_going: as for `execute`.
        memory: GB that steps may use together; None: no limit, if `jobs` are given.
        bus: where progress is published.
    """
    publish_event = bus.steps.track(planned, store) if bus else ignore_event
    with RunDisplay(len(planned)) as shown:

        def on_event(task: Task, event: Event, fraction: float, message: str) -> None:
            shown.on_event(task, event, fraction, message)
            publish_event(task, event, fraction, message)
            if event != "progress":
                log.write(f"{task.full_name}: {event}{': ' if message else ''}{message}")

        if not jobs:
            jobs = default_jobs(tiles=len({item.task.tile for item in planned}))
            memory = memory or free_memory()
        outcome = execute(planned, store, jobs=jobs, on_event=on_event, keep_going=keep_going, memory=memory)
    for task, manifest in outcome.done.items():
        lines = [manifest.metrics["summary"]] if "summary" in manifest.metrics else []
        for line in lines + [f"warning: {text}" for text in manifest.warnings]:
            log.write(f"{task}: {line}")
    return outcome


def plan_and_run(
    tasks: list[Task],
    store: Store,
    log: Log,
    checked: Collection[str],
    digest: Callable[[Path], str] = digest,
    bus: PublishedRun | None = None,
) -> tuple[list[PlannedTask], dict[str, Manifest]]:
    """Plan tasks and run them by `execute_with_progress`.

    Args:
        tasks: those of one tile.
        store: cache of their results.
        log: log of the run.
        checked: names of tasks whose results will be read; these are checked first, and rebuilt if damaged.
        digest: function that computes the digest of a source file.
        bus: publishes the progress.

    Returns:
        The plan, and results by task name.

    Raises:
        ScanError: see `pipeline.core.errors`; results of earlier runs stay.
    """
    planned = plan(tasks, store, digest=digest)
    if drop_damaged(planned, store, checked):
        planned = plan(tasks, store, digest=digest)
    outcome = execute_with_progress(planned, store, log, bus=bus)
    outcome.check()
    return planned, outcome.of_tile()


def show_results(world: Path, report: Path | None) -> list[str]:
    """Print the paths of world and report, and the commands that open the world; returns the lines."""
    lines = [*gazebo.lines(world), *([f"Report: {report}"] if report else [])]
    console.print("\n".join(lines), highlight=False, soft_wrap=True, markup=False)
    return lines


def show_findings(done: Mapping[str, Manifest]) -> list[str]:
    """Print the worst findings about the world; the report has all of them. Returns the lines, without colours."""
    all_findings, lines = findings(done), []
    if all_findings and all_findings[0].level == "unusable":
        lines.append("This world can't be used as it is:")
        console.print(f"[bold red]{lines[-1]}[/]")
    for one in all_findings[:MAX_FINDINGS]:
        text = f"{one.about}: {one.text}"
        lines.append(f"warning: {text}")
        warn(text)
    if len(all_findings) > MAX_FINDINGS:
        rest = len(all_findings) - MAX_FINDINGS
        lines.append(f"{rest} more finding{'s' if rest > 1 else ''} in the report")
        console.print(f"[dim]{lines[-1]}")
    return lines


def show_failed(side: SideProducts, log: Log) -> None:
    """Print a warning for each side product that failed."""
    for text in side.warnings():
        warn(f"{text} (details: {log.path})")


def show_warnings(done: Mapping[str, Manifest]) -> None:
    """Print the warnings of the steps."""
    for task, manifest in done.items():
        for warning in manifest.warnings:
            warn(f"{task}: {warning}")


def default_jobs(tiles: int = 1) -> int:
    """Default number of concurrent steps: one for every two cores that this process may use.

    At least 2, and at most 3 for each tile, as a surface is built for each of three classes.
    """
    return min(max(2, available_cores() // 2), 3 * tiles)
