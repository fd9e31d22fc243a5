"""What users see of a tile's results: its world and its settings, beside the report."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterable
from pathlib import Path

from scan2sim.flows.execute import versions
from scan2sim.flows.planning import Planned
from scan2sim.flows.report import PAGES, SCRIPTS
from scan2sim.flows.settings import Settings
<<<<<<< HEAD
from scan2sim.pipeline.io.worlds import STAMP, link, swap
from scan2sim.pipeline.store import Manifest, Store
from scan2sim.pipeline.types import Tile

THREE = "three.js"
=======
from scan2sim.pipeline.io.worlds import EDITED, link, swap
from scan2sim.pipeline.store import Manifest, Store
from scan2sim.pipeline.types import Tile

SHOWN = ("export", "exposure", "pictures", "score")
"""Nodes whose files, not just figures, are shown."""
>>>>>>> 155724a (Damage to kept results and worlds is noticed and mended; scan2sim verify; names that lead out of their folder are refused)
BULKY = ("poses", "positions", "times")  # parameters that repeat the tile


def publish(
    store: Store, planned: list[Planned], done: dict[str, Manifest], out: Path, tile: Tile, settings: Settings
<<<<<<< HEAD
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
=======
) -> list[str]:
    """Put the world, the exposures and the resolved settings beside the report; a world that is there stays.

    Returns:
        What the user should read.
    """
    edited: list[Path] = []
    keys = {item.node.label: item.key for item in planned}
    source = store.folder("export", keys["export"]) / done["export"].files["world"]
    if not _current(source, out / "world", keys["export"]):
        edited = _publish_world(source, out, keys["export"])
    solved = store.folder("exposure", keys["exposure"]) / done["exposure"].files["exposures"]
    shutil.copyfile(solved, out / "exposure.json")  # for the next tile, as its `exposure.prior`
>>>>>>> 155724a (Damage to kept results and worlds is noticed and mended; scan2sim verify; names that lead out of their folder are refused)
    config = {
        "tile": str(tile.path),
        "versions": versions(),
        "set": settings.values,
        "steps": {label: {k: v for k, v in m.params.items() if k not in BULKY} for label, m in done.items()},
    }
    (out / "config.json").write_text(json.dumps(config, indent=1), encoding="utf-8")
    return [f"{path} was changed since it was made; what it held is kept as {path.name}~ beside it" for path in edited]


<<<<<<< HEAD
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
=======
def to_read(store: Store, planned: Iterable[Planned], out: Path) -> set[str]:
    """Labels of what `publish` and the report will read; a world that is published already isn't read again."""
    return set(SHOWN) - ({"export"} if published(store, planned, out) else set())


def published(store: Store, planned: Iterable[Planned], out: Path) -> bool:
    """Whether the world beside the report is that of the kept result, file by file."""
    key = next(item.key for item in planned if item.node.label == "export")
    manifest = store.find("export", key)
    return manifest is not None and _current(store.folder("export", key) / manifest.files["world"], out / "world", key)


def _current(source: Path, world: Path, key: str) -> bool:
    """Whether a published world is of this result, and its files as they were when they were published."""
    stamp = world / ".result"
    files = [path.relative_to(source) for path in source.rglob("*") if path.is_file()]
    return stamp.is_file() and stamp.read_text() == key and all(_same(source / file, world / file) for file in files)


def _same(kept: Path, shown: Path) -> bool:
    """Whether a file is a link to the kept one, or a copy that hasn't been changed since."""
    try:
        a, b = kept.stat(), shown.stat()
    except OSError:
        return False
    return os.path.samestat(a, b) or (a.st_size, a.st_mtime_ns) == (b.st_size, b.st_mtime_ns)


def _publish_world(source: Path, out: Path, key: str) -> list[Path]:
    """Copy the world from the store (meshes and textures as hard links, where that can be).

    Returns:
        Files that were changed by hand, or damaged, since the same world was published; what they held is kept.
    """
    fresh, world = out / ".world", out / "world"
    shutil.rmtree(fresh, ignore_errors=True)
    shutil.copytree(source, fresh, copy_function=link)
    changed = []
    if (world / ".result").is_file() and (world / ".result").read_text() == key:
        for file in (path.relative_to(world) for path in world.rglob("*") if path.suffix in EDITED):
            kept = fresh / file
            if kept.is_file() and kept.read_bytes() != (world / file).read_bytes():
                shutil.copy2(world / file, kept.with_name(f"{kept.name}~"))
                changed.append(world / file)
    (fresh / ".result").write_text(key)
    swap(fresh, world)
    return changed
>>>>>>> 155724a (Damage to kept results and worlds is noticed and mended; scan2sim verify; names that lead out of their folder are refused)
