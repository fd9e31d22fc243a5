"""`scan2sim slam study`: influence of resolution, bit rate and frame rate on the error (D3.2, tables 4 and 5)."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from scan2sim.flows.commands.display import RunDisplay, console, warn
from scan2sim.flows.commands.log import Log
from scan2sim.flows.commands.run_with_progress import execute_with_progress
from scan2sim.flows.engine.execution import limit_cores
from scan2sim.flows.engine.lock import locked
from scan2sim.flows.engine.planning import STORE, PlannedTask, plan
from scan2sim.flows.engine.progress import PublishedRun, published
from scan2sim.flows.engine.ready_queue import Event
from scan2sim.flows.pipelines.graph import Task
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.study import Cell, Study, build_graph, cells, rejection, segments_of, truth_length
from scan2sim.flows.reports.study import Result, Tables, missing_segments, summary, write
from scan2sim.pipeline.core.cache import Digests, Store
from scan2sim.pipeline.core.errors import SettingError, SpaceError
from scan2sim.slam.steps.encode import can_encode
from scan2sim.slam.steps.evaluate import EVALUATE
from scan2sim.slam.steps.track import TRACK, can_track
from scan2sim.slam.trajectory.evaluate import read_truth

T = TypeVar("T", int, float)
WRITE_INTERVAL_S = 20.0
"""Minimum time between two updates of the tables while cells are computed; their plot takes a second."""


def study_compression(
    source: Path, out: Path, *, truth: Path | None, gps: Path | None, mask: Path | None, heights: str, bitrates: str,
    rates: str, jobs: int, settings: Settings, bus: str | None = None,
) -> Path:  # fmt: skip
    """Run the study and print its table; truth, GPS and mask default to files of the drive's folder.

    Raises:
        ScanError: see `pipeline.core.errors`.
    """

    def found(given: Path | None, name: str) -> Path | None:
        default = source / name
        return given or (default if source.is_dir() and default.is_file() else None)

    known = found(truth, "truth.csv")
    if known is None:
        raise SettingError("--truth", "is missing", "Give a trajectory or a GPS track to compare with")
    requested = Study.of("", {
        "source": source, "truth": known, "gps": found(gps, "gps.csv"), "mask": found(mask, "mask.png"),
        "heights": _numbers("--heights", heights, int), "bitrates": _numbers("--bitrates", bitrates, float),
        "rates": _numbers("--rates", rates, float),
    }, remedy="Change the option")  # fmt: skip
    with published(bus, "slam study", str(source)) as on_bus:
        table = study(requested, out, settings, jobs, on_bus)
    console.print(table.read_text(encoding="utf-8"), highlight=False, markup=False, soft_wrap=True)
    console.print(f"Table: {table}", highlight=False, soft_wrap=True, markup=False)
    return table


def study(requested: Study, out: Path, settings: Settings, jobs: int = 1, bus: PublishedRun | None = None) -> Path:
    """Run the cells that no earlier run has finished; returns the path of the table of all cells, `out/table.md`.

    A cell whose tracking is lost is a result; one that fails is N/A in the table, with its reason. The tables are
    written while cells finish, so that an interrupted study leaves those of the finished cells.

    Raises:
        ScanError: see `pipeline.core.errors`.
    """
    can_encode(None)
    can_track(settings.params(TRACK))
    video = requested.video()
    length = truth_length(video, read_truth(requested.truth))
    segments = segments_of(length)
    tasks = build_graph(requested, video, segments, settings)
    with locked(out):
        store = Store(out / STORE)
        digests = Digests(store.root / "digests.json")
        planned = plan(tasks, store, digest=digests)
        log = Log(out / "run.log")
        limit_cores(max(1, len(os.sched_getaffinity(0)) // jobs))
        backend = settings.params(TRACK).backend
        tables = Tables(video, requested.gps is not None, backend, length, segments, cells(requested), {})
        if note := missing_segments(tables):
            warn(note)
        progress = _Progress(out, tables, planned, store)
        try:
            with log.errors(out):
                outcome = execute_with_progress(planned, store, log, jobs, keep_going=True, bus=bus, display=progress)
                progress.failed |= {task.group: f"{e.where}: {e.cause}" for task, e in outcome.failed.items()}
        finally:
            table = progress.write()
            digests.save()
        for error in outcome.failed.values():
            if isinstance(error, SpaceError):  # not the fault of a single cell
                raise error
        store.sweep({item.task.full_name: item.key for item in planned})
    return table


class _Progress(RunDisplay):
    """Progress of the study by cells, with the time left; writes the tables while it runs.

    Attributes:
        failed: why cells failed, by their names.
    """

    def __init__(self, out: Path, tables: Tables, planned: Sequence[PlannedTask], store: Store) -> None:
        super().__init__(len(planned), "study", lines=False)
        self.failed: dict[str, str] = {}
        self._out, self._tables, self._planned, self._store = out, tables, planned, store
        self._left = {cell.name: cell for cell in tables.cells if rejection(cell, tables.video) is None}
        self._total, self._computed = len(self._left), 0.0
        self._began, self._written = time.monotonic(), -math.inf

    def on_event(self, task: Task, event: Event, fraction: float, message: str) -> None:
        """Show an event; print a line for each cell that this run finishes."""
        super().on_event(task, event, fraction, message)
        if event == "failed":
            self.failed[task.group] = message
        elif event not in ("done", "cached") or task.step is not EVALUATE:
            return
        cell = self._left.pop(task.group, None)
        if cell is None:
            return
        done = f"{self._total - len(self._left)} of {self._total} cells"
        if event != "cached":
            self._computed += cell.cost
            done += self._time_left()
            result = summary(self._result(cell), self._tables.segments)
            console.print(f"{cell.label}: {result}; {done}", highlight=False, soft_wrap=True, markup=False)
            if time.monotonic() - self._written > WRITE_INTERVAL_S:
                self.write()
        self.status(done)

    def write(self) -> Path:
        """Write the tables and the plot of the cells that are finished, failed or impossible."""
        results = {cell: result for cell in self._tables.cells if (result := self._result(cell))}
        table = write(self._out, replace(self._tables, results=results))
        self._written = time.monotonic()
        return table

    def _time_left(self) -> str:
        """Time left by the speed of this run so far; cells take time in proportion to their `cost`."""
        if not self._left:
            return ""
        seconds = (time.monotonic() - self._began) / self._computed * sum(cell.cost for cell in self._left.values())
        return f", {seconds / 60:.0f} min left" if seconds > 90 else f", {seconds:.0f} s left"

    def _result(self, cell: Cell) -> Result | None:
        """Result of a cell; None if it hasn't run yet."""
        if reason := rejection(cell, self._tables.video):
            return Result(reason=reason)
        items = [item for item in self._planned if item.task.group == cell.name]
        done = [found for item in items if (found := self._store.find(item.task.full_name, item.key))]
        figures = {key: value for manifest in done for key, value in manifest.metrics.items()}
        if cell.name in self.failed:
            return Result(figures, self.failed[cell.name])
        if len(done) < len(items):
            return None
        reason = figures.pop("reason", None)
        return Result(figures | {"seconds": round(sum(one.seconds for one in done), 1)}, reason)


def _numbers(option: str, text: str, kind: type[T]) -> list[T]:
    try:
        return [kind(part) for part in text.split(",")]
    except ValueError:
        raise SettingError(option, f"`{text}` isn't a list of numbers", "Write for example 512,1024") from None
