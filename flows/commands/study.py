"""`scan2sim slam study`: influence of resolution, bit rate and frame rate on the error (D3.2, tables 4 and 5)."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TypeVar

from scan2sim.flows.commands.display import console
from scan2sim.flows.commands.log import Log
from scan2sim.flows.commands.run_with_progress import execute_with_progress
from scan2sim.flows.engine.execution import limit_cores
from scan2sim.flows.engine.lock import locked
from scan2sim.flows.engine.planning import STORE, PlannedTask, plan
from scan2sim.flows.engine.progress import PublishedRun, published
from scan2sim.flows.pipelines.graph import TaskId
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.study import Cell, Study, build_graph, cells, rejection, segment_of
from scan2sim.flows.reports.study import Result, Tables, write
from scan2sim.pipeline.core.cache import Digests, Store
from scan2sim.pipeline.core.errors import ScanError, SettingError, SpaceError
from scan2sim.pipeline.core.optional_deps import require
from scan2sim.slam.steps.track import TRACK, can_track
from scan2sim.slam.trajectory.evaluate import read_truth
from scan2sim.slam.video import Video

T = TypeVar("T", int, float)


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

    A cell that fails is N/A in the table, with its reason; an interrupted study leaves a table of the finished cells.

    Raises:
        ScanError: see `pipeline.core.errors`.
    """
    require("slam study", "av", "matplotlib")
    can_track(settings.params(TRACK))
    video = requested.video()
    segment = segment_of(video, read_truth(requested.truth))
    tasks = build_graph(requested, video, segment, settings)
    failed: Mapping[TaskId, ScanError] = {}
    with locked(out):
        store = Store(out / STORE)
        digests = Digests(store.root / "digests.json")
        planned = plan(tasks, store, digest=digests)
        log = Log(out / "run.log")
        limit_cores(max(1, (os.cpu_count() or 1) // jobs))
        try:
            with log.errors(out):
                failed = execute_with_progress(planned, store, log, jobs, keep_going=True, bus=bus).failed
        finally:
            backend, results = settings.params(TRACK).backend, _results(requested, video, planned, store, failed)
            table = write(out, Tables(video, requested.gps is not None, backend, segment, cells(requested), results))
            digests.save()
        for error in failed.values():
            if isinstance(error, SpaceError):  # not the fault of a single cell
                raise error
        store.sweep({item.task.full_name: item.key for item in planned})
    return table


def _results(
    requested: Study, video: Video, planned: Iterable[PlannedTask], store: Store, failed: Mapping[TaskId, ScanError]
) -> dict[Cell, Result]:
    """Results of the cells that are finished, failed or impossible."""
    results = {cell: Result(reason=rejection(cell, video)) for cell in cells(requested) if rejection(cell, video)}
    for cell in cells(requested):
        cell_tasks = [item.task for item in planned if item.task.group == cell.name]
        keys = [item.key for item in planned if item.task.group == cell.name]
        manifests = [store.find(task.full_name, key) for task, key in zip(cell_tasks, keys, strict=True)]
        done = [manifest for manifest in manifests if manifest is not None]
        error = next((failed[task.id] for task in cell_tasks if task.id in failed), None)
        metrics = {key: value for manifest in done for key, value in manifest.metrics.items()}
        if error is not None:
            results[cell] = Result(metrics, f"{error.where}: {error.cause}")
        elif cell_tasks and len(done) == len(cell_tasks):
            reason = metrics.pop("reason", None)
            results[cell] = Result(metrics | {"seconds": round(sum(one.seconds for one in done), 1)}, reason)
    return results


def _numbers(option: str, text: str, kind: type[T]) -> list[T]:
    try:
        return [kind(part) for part in text.split(",")]
    except ValueError:
        raise SettingError(option, f"`{text}` isn't a list of numbers", "Write for example 512,1024") from None
