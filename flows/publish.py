"""What users see of a tile's results: its world and its settings, beside the report."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

from scan2sim.flows.execute import versions
from scan2sim.flows.planning import Planned
from scan2sim.flows.settings import Settings
from scan2sim.pipeline.io.worlds import link, swap
from scan2sim.pipeline.store import Manifest, Store
from scan2sim.pipeline.types import Tile

BULKY = ("poses", "positions", "times")  # parameters that repeat the tile


def publish(
    store: Store, planned: list[Planned], done: dict[str, Manifest], out: Path, tile: Tile, settings: Settings
) -> None:
    """Put the world, the exposures and the resolved settings beside the report; a world that is there stays."""
    key = next(p.key for p in planned if p.node.label == "export")
    source = store.folder("export", key) / done["export"].files["world"]
    _publish_world(source, out, key)
    key = next(p.key for p in planned if p.node.label == "exposure")
    solved = store.folder("exposure", key) / done["exposure"].files["exposures"]
    shutil.copyfile(solved, out / "exposure.json")  # for the next tile, as its `exposure.prior`
    config = {
        "tile": str(tile.path),
        "versions": versions(),
        "set": settings.values,
        "steps": {label: {k: v for k, v in m.params.items() if k not in BULKY} for label, m in done.items()},
    }
    (out / "config.json").write_text(json.dumps(config, indent=1), encoding="utf-8")


def _publish_world(source: Path, out: Path, key: str) -> None:
    """Copy the world from the store (meshes and textures as hard links, where that can be), unless it is the same."""
    stamp = out / "world" / ".result"
    files = [path.relative_to(source) for path in source.rglob("*") if path.is_file()]
    if stamp.is_file() and stamp.read_text() == key and all((out / "world" / file).is_file() for file in files):
        return
    fresh = out / ".world"
    shutil.rmtree(fresh, ignore_errors=True)
    shutil.copytree(source, fresh, copy_function=link)
    (fresh / ".result").write_text(key)
    swap(fresh, out / "world")
