"""`scan2sim slam study`: what resolution, bit rate and frame rate of the video cost (D3.2, tables 4 and 5)."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TypeVar

from scan2sim.flows.commands.display import console
from scan2sim.flows.commands.log import Log
from scan2sim.flows.commands.run_with_progress import execute_shown
from scan2sim.flows.engine.execution import limit_cores
from scan2sim.flows.engine.lock import locked
from scan2sim.flows.engine.planning import STORE, Planned, plan
from scan2sim.flows.engine.progress import PublishedRun, published
from scan2sim.flows.pipelines.graph import NodeId
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.study import Cell, Study, cells, recipe, refused, segment_of
from scan2sim.flows.reports.study import Result, Tables, write
from scan2sim.pipeline.core.cache import Digests, Store
from scan2sim.pipeline.core.errors import ScanError, SettingError, SpaceError
from scan2sim.pipeline.core.optional_deps import need
from scan2sim.slam.steps.track import TRACK, can_track
from scan2sim.slam.trajectory.evaluate import read_truth
from scan2sim.slam.video import Video

T = TypeVar("T", int, float)


def study_compression(
    source: Path, out: Path, *, truth: Path | None, gps: Path | None, mask: Path | None, heights: str, bitrates: str,
    rates: str, jobs: int, settings: Settings, bus: str | None = None,
) -> Path:  # fmt: skip
    """Print the table of what compression costs; in a drive's folder, what isn't named is found by its name.

    Raises:
        ScanError: see `pipeline.core.errors`.
    """

    def found(given: Path | None, name: str) -> Path | None:
        beside = source / name
        return given or (beside if source.is_dir() and beside.is_file() else None)

    known = found(truth, "truth.csv")
    if known is None:
        raise SettingError("--truth", "is missing", "Give a trajectory, or a GPS track, to compare with")
    requested = Study.of("", {
        "source": source, "truth": known, "gps": found(gps, "gps.csv"), "mask": found(mask, "mask.png"),
        "heights": _numbers("--heights", heights, int), "bitrates": _numbers("--bitrates", bitrates, float),
        "rates": _numbers("--rates", rates, float),
    }, remedy="Give others")  # fmt: skip
    with published(bus, "slam study", str(source)) as on_bus:
        table = study(requested, out, settings, jobs, on_bus)
    console.print(table.read_text(encoding="utf-8"), highlight=False, markup=False, soft_wrap=True)
    console.print(f"Table: {table}", highlight=False, soft_wrap=True, markup=False)
    return table


def study(requested: Study, out: Path, settings: Settings, jobs: int = 1, bus: PublishedRun | None = None) -> Path:
    """Run the cells that no earlier run has finished; returns `out/table.md`, which holds them all.

    A cell that fails is N/A with its reason; an interrupted study leaves the tables of what is there.

    Raises:
        ScanError: see `pipeline.core.errors`.
    """
    need("slam study", "av", "matplotlib")
    can_track(settings.params(TRACK))
    video = requested.video()
    segment = segment_of(video, read_truth(requested.truth))
    nodes = recipe(requested, video, segment, settings)
    failed: Mapping[NodeId, ScanError] = {}
    with locked(out):
        store = Store(out / STORE)
        digests = Digests(store.root / "digests.json")
        planned = plan(nodes, store, digest=digests)
        log = Log(out / "run.log")
        limit_cores(max(1, (os.cpu_count() or 1) // jobs))
        try:
            with log.errors(out):
                failed = execute_shown(planned, store, log, jobs, to_the_end=True, bus=bus).failed
        finally:
            backend, results = settings.params(TRACK).backend, _results(requested, video, planned, store, failed)
            table = write(out, Tables(video, requested.gps is not None, backend, segment, cells(requested), results))
            digests.save()
        for error in failed.values():
            if isinstance(error, SpaceError):  # no cell's fault
                raise error
        store.sweep({item.node.full_name: item.key for item in planned})
    return table


def _results(
    requested: Study, video: Video, planned: Iterable[Planned], store: Store, failed: Mapping[NodeId, ScanError]
) -> dict[Cell, Result]:
    """Of the cells that are done, or can't be."""
    results = {cell: Result(reason=refused(cell, video)) for cell in cells(requested) if refused(cell, video)}
    for cell in cells(requested):
        own = [item.node for item in planned if item.node.group == cell.name]
        keys = [item.key for item in planned if item.node.group == cell.name]
        made = [store.find(node.full_name, key) for node, key in zip(own, keys, strict=True)]
        done = [manifest for manifest in made if manifest is not None]
        error = next((failed[node.id] for node in own if node.id in failed), None)
        facts = {key: value for manifest in done for key, value in manifest.facts.items()}
        if error is not None:
            results[cell] = Result(facts, f"{error.where}: {error.cause}")
        elif own and len(done) == len(own):
            reason = facts.pop("reason", None)
            results[cell] = Result(facts | {"seconds": round(sum(one.seconds for one in done), 1)}, reason)
    return results


def _numbers(option: str, text: str, kind: type[T]) -> list[T]:
    try:
        return [kind(part) for part in text.split(",")]
    except ValueError:
        raise SettingError(option, f"`{text}` isn't a list of numbers", "Write 512,1024") from None
