"""Shared by the commands of `scan2sim orchestrate`: the client of OSM, and progress on a terminal and without one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from scan2sim.flows.commands.display import console, print_line, progress, warn
from scan2sim.pipeline.core.step import Report
from scan2sim.services.orchestration.settings import Connection, OperationParams

if TYPE_CHECKING:
    from scan2sim.services.orchestration.lifecycle import WaitPolicy
    from scan2sim.services.orchestration.osm import Osm


@contextmanager
def osm_client(params: Connection, pacer: Any = None) -> Iterator[Osm]:
    """Client of OSM; warns when OSM is slow."""
    from scan2sim.services.orchestration.osm import Osm

    with Osm(params, before_request=pacer, on_slow=warn) as osm:
        yield osm


@contextmanager
def operation(params: OperationParams, name: str) -> Iterator[tuple[Osm, WaitPolicy, Any]]:
    """Client of OSM, how long to wait, and the function that shows the progress of a single operation."""
    from scan2sim.services.orchestration.lifecycle import WaitPolicy

    with osm_client(params) as osm, progress_lines(name) as report:
        yield osm, WaitPolicy(params.timeout, params.wait), lambda text: report(0.5, text)


@contextmanager
def progress_lines(title: str) -> Iterator[Report]:
    """A progress bar on a terminal; elsewhere (CI, a log file) a line for each new message."""
    if console.is_terminal:
        with progress(title) as report:
            yield report
        return
    last: set[str] = set()

    def report_line(fraction: float, message: str = "") -> None:
        if message and message not in last:
            last.clear()
            last.add(message)
            print_line(f"{title}: {message}")

    yield report_line
