"""Runs the compression study: the cells of its tables, of which finished ones are cached, and writes the tables."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from bench.slam.study.cells import Cell, Study, build_graph, cells, rejection, segments_of, truth_length
from bench.slam.study.encode import can_encode
from bench.slam.study.evaluate import EVALUATE
from bench.slam.study.tables import Result, Tables, missing_segments, summary, write
from scan2sim.flows.engine.execution import execute, limit_cores
from scan2sim.flows.engine.lock import locked
from scan2sim.flows.engine.planning import STORE, PlannedTask, plan
from scan2sim.flows.engine.ready_queue import Event
from scan2sim.flows.pipelines.graph import Task
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.pipeline.core.cache import Digests, Store
from scan2sim.pipeline.core.errors import SpaceError
from scan2sim.slam.steps.track import TRACK, can_track
from scan2sim.slam.trajectory.evaluate import read_truth

WRITE_INTERVAL_S = 20.0
"""Minimum time between two updates of the tables while cells are computed; their plot takes a second."""


def study(requested: Study, out: Path, settings: Settings, jobs: int = 1) -> Path:
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
        limit_cores(max(1, len(os.sched_getaffinity(0)) // jobs))
        backend = settings.params(TRACK).backend
        tables = Tables(video, requested.gps is not None, backend, length, segments, cells(requested), {})
        if note := missing_segments(tables):
            print(f"warning: {note}", flush=True)
        progress = Progress(out, tables, planned, store)
        try:
            outcome = execute(planned, store, jobs=jobs, on_event=progress.on_event, keep_going=True)
            progress.failed |= {task.group: f"{e.where}: {e.cause}" for task, e in outcome.failed.items()}
        finally:
            table = progress.write()
            digests.save()
        for error in outcome.failed.values():
            if isinstance(error, SpaceError):  # not the fault of a single cell
                raise error
        store.sweep({item.task.full_name: item.key for item in planned})
    print(f"{progress.cached} of {len(planned)} results reused from earlier runs", flush=True)
    return table


class Progress:
    """Progress of the study by cells, with the time left; writes the tables while it runs.

    Attributes:
        failed: why cells failed, by their names.
        cached: number of results of earlier runs that were reused.
    """

    def __init__(self, out: Path, tables: Tables, planned: Sequence[PlannedTask], store: Store) -> None:
        self.failed: dict[str, str] = {}
        self.cached = 0
        self._out, self._tables, self._planned, self._store = out, tables, planned, store
        self._left = {cell.name: cell for cell in tables.cells if rejection(cell, tables.video) is None}
        self._total, self._computed = len(self._left), 0.0
        self._began, self._written = time.monotonic(), -math.inf

    def on_event(self, task: Task, event: Event, fraction: float, message: str) -> None:
        """Count an event; print a line for each cell that this run finishes."""
        self.cached += (event == "cached") - (event == "again")
        if event == "failed":
            self.failed[task.group] = message
        elif event not in ("done", "cached") or task.step is not EVALUATE:
            return
        cell = self._left.pop(task.group, None)
        if cell is None or event == "cached":
            return
        self._computed += cell.cost
        done = f"{self._total - len(self._left)} of {self._total} cells{self._time_left()}"
        print(f"{cell.label}: {summary(self._result(cell), self._tables.segments)}; {done}", flush=True)
        if time.monotonic() - self._written > WRITE_INTERVAL_S:
            self.write()

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
