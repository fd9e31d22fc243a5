"""What users see of a tile's results: its world and its settings, beside the report."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

from scan2sim.flows.execute import versions
from scan2sim.flows.planning import Planned
from scan2sim.flows.report import PAGES, SCRIPTS
from scan2sim.flows.settings import Settings
from scan2sim.pipeline.io.worlds import STAMP, link, swap
from scan2sim.pipeline.store import Manifest, Store
from scan2sim.pipeline.types import Tile

THREE = "three.js"
BULKY = ("poses", "positions", "times")  # parameters that repeat the tile


def publish(
    store: Store, planned: list[Planned], done: dict[str, Manifest], out: Path, tile: Tile, settings: Settings
) -> None:
    """Put the world, rasters, exposures and the resolved settings beside the report; a world that is there stays."""
    keys = {p.node.label: p.key for p in planned}

    def result(label: str, name: str) -> Path:
        return store.folder(label, keys[label]) / done[label].files[name]

    _publish(result("export", "world"), out / "world", keys["export"])
    if "rasters" in done:
        _publish(result("rasters", "rasters"), out / "rasters", keys["rasters"])
    elif (out / "rasters" / STAMP).is_file():  # of an earlier world
        shutil.rmtree(out / "rasters")
    if done["preview"].files:
        _publish(result("preview", "preview"), out / SCRIPTS, keys["preview"])
        shutil.copyfile(PAGES / THREE, out / SCRIPTS / THREE)
    shutil.copyfile(result("exposure", "exposures"), out / "exposure.json")  # for the next tile's `exposure.prior`
    config = {
        "tile": str(tile.path),
        "versions": versions(),
        "set": settings.values,
        "steps": {label: {k: v for k, v in m.params.items() if k not in BULKY} for label, m in done.items()},
    }
    (out / "config.json").write_text(json.dumps(config, indent=1), encoding="utf-8")


def _publish(source: Path, place: Path, key: str) -> None:
    """Copy a folder from the store (large files as hard links, where that can be), unless it is the same."""
    stamp = place / STAMP
    files = [path.relative_to(source) for path in source.rglob("*") if path.is_file()]
    if stamp.is_file() and stamp.read_text() == key and all((place / file).is_file() for file in files):
        return
    fresh = place.with_name(f".{place.name}")
    shutil.rmtree(fresh, ignore_errors=True)
    shutil.copytree(source, fresh, copy_function=link)
    (fresh / STAMP).write_text(key)
    swap(fresh, place)
