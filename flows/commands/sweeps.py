"""Trajectory of a scanner whose sweeps are imported, by lidar odometry and fusion with GPS and poses."""

from __future__ import annotations

from pathlib import Path

from scan2sim.flows.commands.display import console, warn
from scan2sim.flows.commands.log import Log
from scan2sim.flows.commands.run_with_progress import plan_and_run
from scan2sim.flows.engine.lock import locked
from scan2sim.flows.engine.planning import STORE
from scan2sim.flows.pipelines.graph import Task
from scan2sim.pipeline.core.cache import Digests, Store
from scan2sim.pipeline.io.worlds.merge import link


def scanner_path(tasks: list[Task], out: Path) -> Path:
    """Run the tasks of a scanner's trajectory (`pipelines.sweeps`), and print a summary; finished tasks are cached.

    Args:
        tasks: those to run.
        out: folder for the trajectory in all formats, and for cached results.

    Returns:
        Path of the `trajectory.csv`.

    Raises:
        ScanError: raised by a step.
    """
    with locked(out):
        store = Store(out / STORE)
        digests = Digests(store.root / "digests.json")
        log = Log(out / "run.log")
        with log.errors(out):
            planned, done = plan_and_run(tasks, store, log, {task.id.name for task in tasks}, digests)
            folder = {item.task.id.name: store.folder(item.task.full_name, item.key) for item in planned}["fuse"]
            for old in out.glob("trajectory.*"):
                old.unlink()
            for made in (folder / "path").iterdir():
                link(str(made), str(out / made.name))
        store.sweep({item.task.id.name: item.key for item in planned})
        digests.save()
    for manifest in done.values():
        for text in manifest.warnings:
            warn(text)
    console.print(str(done["fuse"].metrics["summary"]), highlight=False, soft_wrap=True, markup=False)
    return out / "trajectory.csv"
