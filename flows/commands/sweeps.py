"""The path of a scanner whose sweeps are to be imported: found by steps, each redone if it must be."""

from __future__ import annotations

from pathlib import Path

from scan2sim.flows.commands.display import console, warn
from scan2sim.flows.commands.log import Log
from scan2sim.flows.commands.run_with_progress import run_shown
from scan2sim.flows.engine.lock import locked
from scan2sim.flows.engine.planning import STORE
from scan2sim.flows.pipelines.graph import Node
from scan2sim.pipeline.core.cache import Digests, Store
from scan2sim.pipeline.io.worlds.merge import link


def scanner_path(nodes: list[Node], out: Path) -> Path:
    """Run the graph of a scanner's path (`recipes.sweeps.path`), and say what tells it; what is finished is kept.

    Args:
        out: folder that gets the trajectory in all formats, beside what is kept.

    Returns:
        The `trajectory.csv`.

    Raises:
        ScanError: as the steps.
    """
    with locked(out):
        store = Store(out / STORE)
        digests = Digests(store.root / "digests.json")
        log = Log(out / "run.log")
        with log.errors(out):
            planned, done = run_shown(nodes, store, log, {node.id.name for node in nodes}, digests)
            folder = {item.node.id.name: store.folder(item.node.full_name, item.key) for item in planned}["fuse"]
            for old in out.glob("trajectory.*"):
                old.unlink()
            for made in (folder / "path").iterdir():
                link(str(made), str(out / made.name))
        store.sweep({item.node.id.name: item.key for item in planned})
        digests.save()
    for manifest in done.values():
        for text in manifest.warnings:
            warn(text)
    console.print(str(done["fuse"].facts["told"]), highlight=False, soft_wrap=True, markup=False)
    return out / "trajectory.csv"
