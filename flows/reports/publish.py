"""What users see of a tile's results: its world and its settings, beside the report."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path

from scan2sim.flows.engine.planning import Planned
from scan2sim.flows.engine.versions import versions
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.reports.tile import PAGES, SCRIPTS
from scan2sim.pipeline.core.cache import Manifest, Store
from scan2sim.pipeline.core.errors import DamagedError
from scan2sim.pipeline.core.types import Tile
from scan2sim.pipeline.io.worlds.merge import EDITED, STAMP, link, same_file, same_unless_edited, swap

THREE = "three.js"
PLACES = {"export": ("world", "world"), "rasters": ("rasters", "rasters"), "preview": ("preview", SCRIPTS)}
"""Of nodes, which output is published, and where."""
READ = ("exposure", "pictures", "score")
"""Nodes whose files are read for what is shown."""
BULKY = ("poses", "positions", "times")  # parameters that repeat the tile


def publish(
    store: Store, planned: list[Planned], done: dict[str, Manifest], out: Path, tile: Tile, settings: Settings
) -> list[str]:
    """Put the world, rasters, exposures and the resolved settings beside the report; a world that is there stays.

    Returns:
        What the user should read: of files that were edited.

    Raises:
        DamagedError: a result has gone in the meantime.
    """
    keys = {p.node.id.name: p.key for p in planned}
    changed: list[Path] = []
    places = _published(store, keys, out)
    for node in PLACES.keys() & done.keys():
        if done[node].files and node not in places:
            raise DamagedError(node)
    for node, (source, place) in places.items():
        if not _current(source, place, keys[node]):
            _publish(source, place, keys[node])
        changed += edited(source, place)
    for node, (_, name) in PLACES.items():
        if not (node in done and done[node].files) and (out / name / STAMP).is_file():  # of an earlier world
            shutil.rmtree(out / name)
    if "preview" in done and done["preview"].files:
        shutil.copyfile(PAGES / THREE, out / SCRIPTS / THREE)
    solved = store.folder("exposure", keys["exposure"]) / done["exposure"].files["exposures"]
    shutil.copyfile(solved, out / "exposure.json")  # for the next tile's `exposure.prior`
    config = {
        "tile": str(tile.path),
        "versions": versions(),
        "set": settings.values,
        "steps": {node: {k: v for k, v in m.params.items() if k not in BULKY} for node, m in done.items()},
    }
    (out / "config.json").write_text(json.dumps(config, indent=1), encoding="utf-8")
    return [f"{path} was changed since it was made, and stays so: remove it to have it made anew" for path in changed]


def to_read(store: Store, planned: Iterable[Planned], out: Path) -> set[str]:
    """Labels of results that will be read for what is shown; what is published already isn't read again."""
    keys = {item.node.id.name: item.key for item in planned}
    places = _published(store, keys, out)
    return {*READ, *(node for node, (source, place) in places.items() if not _current(source, place, keys[node]))}


def published(store: Store, planned: Iterable[Planned], out: Path) -> bool:
    """Whether all that is published beside the report is as the kept results are, file by file."""
    keys = {item.node.id.name: item.key for item in planned}
    places = _published(store, keys, out)
    return "export" in places and all(_current(*both, keys[node]) for node, both in places.items())


def _published(store: Store, keys: Mapping[str, str], out: Path) -> dict[str, tuple[Path, Path]]:
    """Of results that are kept, by node: the folder that is to be published, and where."""
    found = {}
    for node, (output, place) in PLACES.items():
        manifest = store.find(node, keys[node]) if node in keys else None
        if manifest is not None and output in manifest.files:
            found[node] = store.folder(node, keys[node]) / manifest.files[output], out / place
    return found


def _current(source: Path, place: Path, key: str) -> bool:
    """Whether a published folder is of this result, and its files, but for edits, as when they were published."""
    files = [path.relative_to(source) for path in source.rglob("*") if path.is_file()]
    return bool(files) and _is_of(place, key) and all(same_unless_edited(source / f, place / f) for f in files)


def _is_of(place: Path, key: str) -> bool:
    """Whether a folder was published of this result."""
    stamp = place / STAMP
    return stamp.is_file() and stamp.read_text(errors="replace", encoding="utf-8") == key


def edited(source: Path, place: Path) -> list[Path]:
    """Published files that were changed by a user (or by damage: nobody can tell which), of kinds that users edit."""
    pairs = [(source / path.relative_to(place), path) for path in sorted(place.rglob("*")) if path.suffix in EDITED]
    return [b for a, b in pairs if a.is_file() and not same_file(a, b) and a.read_bytes() != b.read_bytes()]


def _publish(source: Path, place: Path, key: str) -> None:
    """Copy a folder from the store (large files as hard links, where that can be); edits of the same one stay."""
    fresh = place.with_name(f".{place.name}")
    shutil.rmtree(fresh, ignore_errors=True)
    shutil.copytree(source, fresh, copy_function=link)
    for file in edited(source, place) if _is_of(place, key) else ():
        shutil.copy2(file, fresh / file.relative_to(place))
    (fresh / STAMP).write_text(key, encoding="utf-8")
    swap(fresh, place)
