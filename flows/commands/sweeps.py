"""Tasks that an import depends on: unpacking of a bag, lidar odometry, fusion, reconstruction of photos, ..."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from scan2sim.flows.commands.display import console, warn
from scan2sim.flows.commands.log import Log
from scan2sim.flows.commands.run_with_progress import plan_and_run
from scan2sim.flows.engine.lock import locked
from scan2sim.flows.engine.output_folder import check_own
from scan2sim.flows.engine.planning import STORE
from scan2sim.flows.pipelines.graph import Output, Task
from scan2sim.pipeline.core.cache import Digests, Store
from scan2sim.pipeline.io.file_checks import copy_tree
from scan2sim.pipeline.io.worlds.merge import link


def run_before_import(tasks: Sequence[Task], out: Path, warn: Callable[[str], None] = warn) -> dict[str, Path]:
    """Run all tasks but the last, the import, and print a summary; finished tasks are cached.

    Args:
        tasks: those to run, in order.
        out: folder for cached results, and for an estimated trajectory in all formats; unused if there is only the
            import.
        warn: receives the warnings of the tasks; default: the terminal.

    Returns:
        Inputs of the import by name.

    Raises:
        ScanError: raised by a step.
    """
    *before, last = tasks
    return run_cached(before, last.inputs, out, warn)


def run_cached(
    tasks: Sequence[Task], wanted: Mapping[str, Path | Output], out: Path, warn: Callable[[str], None] = warn
) -> dict[str, Path]:
    """Run tasks as `run_before_import`; returns the paths of `wanted` files and outputs."""
    found = {name: source for name, source in wanted.items() if isinstance(source, Path)}
    if not tasks:
        return found
    check_own(out)
    with locked(out):
        store = Store(out / STORE)
        digests = Digests(store.root / "digests.json")
        log = Log(out / "run.log")
        with log.errors(out):
            planned, done = plan_and_run(list(tasks), store, log, {task.id.name for task in tasks}, digests)
        folders = {item.task.id: store.folder(item.task.full_name, item.key) for item in planned}
        for name, source in wanted.items():
            if isinstance(source, Output):
                found[name] = folders[source.task] / done[source.task.full_name].files[source.name]
        for old in (*out.glob("trajectory.*"), *out.glob("colmap/*")):
            old.unlink()
        for item in planned:
            if "path" in done[item.task.full_name].files:
                copy_tree(folders[item.task.id] / "path", out, link)
        store.sweep({item.task.id.name: item.key for item in planned})
        digests.save()
    for manifest in done.values():
        for text in manifest.warnings:
            warn(text)
        summary = manifest.metrics.get("summary")
        if summary is not None and "check" not in manifest.files:  # that of a check is printed after the import
            console.print(str(summary), highlight=False, soft_wrap=True, markup=False)
    return found


def cached_check(task: Task, out: Path) -> Path:
    """Run a task that checks poses; returns the folder `check` of its result, cached beside the tile `out`."""
    return run_cached([task], {"check": Output(task.id, "check")}, out.with_name(f"{out.name}-path"))["check"]
