"""Console output of long operations: progress bars on a terminal, plain lines elsewhere."""

from __future__ import annotations

import json
import tempfile
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Column

from scan2sim.flows.engine.ready_queue import Event
from scan2sim.flows.pipelines.graph import Task
from scan2sim.pipeline.core.errors import printable
from scan2sim.pipeline.core.step import Report

_quiet: ContextVar[bool] = ContextVar("quiet", default=False)


class _Console(Console):
    """A console that may be quiet for a single run, while others in the same process print in their own threads."""

    @property
    def quiet(self) -> bool:
        """Whether the running thread prints nothing."""
        return _quiet.get()

    @quiet.setter
    def quiet(self, value: bool) -> None:
        _quiet.set(value)


console = _Console()


@contextmanager
def shown(progress: bool) -> Iterator[None]:
    """Print what happens in the context, or nothing; other threads print as they do."""
    before, console.quiet = console.quiet, not progress
    try:
        yield
    finally:
        console.quiet = before


def _progress() -> Progress:
    return Progress(
        SpinnerColumn(),
        TextColumn("{task.description:<22}"),
        BarColumn(bar_width=28, table_column=Column(no_wrap=True)),
        TimeElapsedColumn(),
        # takes the rest of the line: long messages must not shrink the bar on narrow terminals
        TextColumn("[dim]{task.fields[message]}", table_column=Column(ratio=1, no_wrap=True, overflow="ellipsis")),
        expand=True,
        console=console,
        transient=True,
        disable=console.quiet or not console.is_terminal,  # its thread would print, too
    )


@contextmanager
def progress(title: str) -> Iterator[Report]:
    """A progress bar for one long call."""
    with _progress() as bars:
        task = bars.add_task(title, total=1.0, message="")

        def report(fraction: float, message: str = "") -> None:
            bars.update(task, completed=fraction, message=escape(message))

        yield report


def warn(text: str) -> None:
    """Show a warning."""
    console.print(f"[yellow]warning:[/] {escape(printable(text))}", highlight=False, soft_wrap=True)


def print_line(text: str) -> None:
    """Print a line as it is: without markup, colours or wrapping."""
    console.print(text, highlight=False, markup=False, soft_wrap=True)


def print_json(value: Any) -> None:
    """Print a result for other programs to standard output."""
    print(json.dumps(value, indent=1, allow_nan=False))


@contextmanager
def messages_on_stderr(active: bool) -> Iterator[None]:
    """If active, messages and progress go to standard error, so that standard output is the JSON only."""
    before = console.stderr
    console.stderr = before or active
    try:
        yield
    finally:
        console.stderr = before


class RunDisplay:
    """A progress bar for each running task and one for the whole run, and a line for each finished task.

    Args:
        task_count: tasks of the run, cached ones included.
    """

    def __init__(self, task_count: int) -> None:
        self._bars = _progress()
        self._task_count = task_count
        self._bar_ids: dict[str, TaskID] = {}
        self._started: dict[str, float] = {}
        self._done = self._cached = 0

    def __enter__(self) -> RunDisplay:
        self._bars.start()
        self._whole = self._bars.add_task("[bold]tile", total=self._task_count, message="")
        return self

    def __exit__(self, *_: object) -> None:
        self._bars.stop()
        if self._cached:
            console.print(f"[dim]{self._cached} of {self._task_count} results reused from earlier runs")

    def on_event(self, task: Task, event: Event, fraction: float, message: str) -> None:
        """Show an event: an `EventCallback` of `execute`."""
        if event == "start":
            self._started[task.full_name] = time.perf_counter()
            self._bar_ids[task.full_name] = self._bars.add_task(task.full_name, total=1.0, message="")
        elif event == "progress":
            self._bars.update(self._bar_ids[task.full_name], completed=fraction, message=escape(message))
        elif event == "again":
            if task.full_name in self._bar_ids:
                self._bars.remove_task(self._bar_ids.pop(task.full_name))
            self._done, self._cached = self._done - 1, self._cached - 1
            console.print(f"[yellow]![/] {escape(message)}", highlight=False, soft_wrap=True)
        else:
            self._done += 1
            self._cached += event == "cached"
            self._bars.update(self._whole, completed=self._done)
            if event in ("done", "failed"):
                self._bars.remove_task(self._bar_ids.pop(task.full_name))
                seconds = time.perf_counter() - self._started[task.full_name]
                failed = "[yellow]✗[/]" if task.side_product else "[red]✗[/]"
                mark = "[green]✓[/]" if event == "done" else failed
                console.print(f"{mark} {task.full_name:<22}[dim]{seconds:7.1f} s  {self._done}/{self._task_count}")


def log_unexpected(error: BaseException) -> str:
    """Write the traceback of an unexpected error to a temporary file, or print it; returns where it is."""
    try:
        file = tempfile.NamedTemporaryFile(
            "w", prefix="scan2sim-error-", suffix=".log", delete=False, encoding="utf-8", errors="backslashreplace"
        )
        with file:
            file.write("".join(traceback.format_exception(error)))
    except OSError:  # no folder for temporary files, or no space in it
        traceback.print_exception(error)
        return "the traceback above"
    return file.name
