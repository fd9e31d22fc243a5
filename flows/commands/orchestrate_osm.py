"""Shared by the commands of `scan2sim orchestrate`: client of OSM, results, progress with and without a terminal."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from scan2sim.flows.commands.display import console, messages_on_stderr, print_json, print_line, progress, warn
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
def operation(params: OperationParams, name: str, as_json: bool) -> Iterator[tuple[Osm, WaitPolicy, Any]]:
    """Client of OSM, how long to wait, and the function that shows the progress of a single operation.

    With `as_json` progress goes to standard error.
    """
    from scan2sim.services.orchestration.lifecycle import WaitPolicy

    with messages_on_stderr(as_json), osm_client(params) as osm, progress_lines(name) as report:
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


def print_result(as_json: bool, text: str, **facts: Any) -> None:
    """Print the result of a single operation: as a line, or its facts as JSON."""
    print_json(facts) if as_json else print_line(text)
