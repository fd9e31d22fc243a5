"""Publishes a tile's results from the cache to the output folder: world, rasters, preview and settings."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path

from scan2sim.flows.engine.planning import PlannedTask
from scan2sim.flows.engine.versions import versions
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.reports.side_products import SideProducts
from scan2sim.flows.reports.tile import PAGES, SCRIPTS
from scan2sim.pipeline.core.cache import Manifest, Store
from scan2sim.pipeline.core.errors import DamagedError
from scan2sim.pipeline.core.types import Tile
from scan2sim.pipeline.io.file_checks import copy_tree
from scan2sim.pipeline.io.worlds.merge import (
    STAMP_FILE,
    USER_EDITABLE_SUFFIXES,
    link,
    same_file,
    same_unless_edited,
    swap,
)

PAGE_SCRIPTS = ("three.js", "splats.js")
"""Scripts of the report's 3D view, beside its data."""
PUBLISHED_OUTPUTS = {"export": ("world", "world"), "rasters": ("rasters", "rasters"), "preview": ("preview", SCRIPTS)}
"""Task to the output that is published, and its folder in the output folder."""
REPORTED_TASKS = ("exposure", "pictures", "score")
"""Tasks whose files are read for the report."""


def publish(
    store: Store,
    planned: list[PlannedTask],
    done: dict[str, Manifest],
    out: Path,
    tile: Tile,
    settings: Settings,
    side: SideProducts,
    prefix: str = "",
) -> list[str]:
    """Publish the world, rasters, exposures and resolved settings; what is up to date stays.

    Args:
        store: cache of the tile's results.
        planned, done: its tasks, and results by name within the tile.
        out: output folder of the tile.
        tile: the tile.
        settings: of the run.
        side: records failures of everything but the world.
        prefix: of the names of failures: `street_0001/` for a survey's tile.

    Returns:
        Warnings about files that the user has edited.

    Raises:
        DamagedError: a cached result was deleted during the run.
    """
    keys = {p.task.id.name: p.key for p in planned}
    folders = _published_folders(store, keys, out)
    changed = _publish_output("export", folders, keys)
    for task, (_, name) in PUBLISHED_OUTPUTS.items():
        if task in done and done[task].files:
            if task != "export":
                with side.attempt(f"{prefix}{task}", out / name):
                    changed += _publish_output(task, folders, keys)
        elif (out / name / STAMP_FILE).is_file():  # published from an earlier world
            shutil.rmtree(out / name)
    if (out / SCRIPTS).is_dir():
        with side.attempt(f"{prefix}preview"):
            for script in PAGE_SCRIPTS:
                shutil.copyfile(PAGES / script, out / SCRIPTS / script)
    with side.attempt(f"{prefix}exposure.json", out / "exposure.json"):
        solved = store.folder("exposure", keys["exposure"]) / done["exposure"].files["exposures"]
        shutil.copyfile(solved, out / "exposure.json")  # for setting `exposure.prior` of other tiles
    with side.attempt(f"{prefix}config.json", out / "config.json"):
        config = {
            "tile": str(tile.path),
            "versions": versions(),
            "set": settings.values,
            "steps": {task: {k: v for k, v in m.params.items() if k != "context"} for task, m in done.items()},
        }
        (out / "config.json").write_text(json.dumps(config, indent=1), encoding="utf-8")
    return [f"{path} was edited and is kept; delete it to have it rebuilt" for path in changed]


def _publish_output(task: str, folders: Mapping[str, tuple[Path, Path]], keys: Mapping[str, str]) -> list[Path]:
    """Publish the output of a task, unless it is up to date; returns the files that the user has edited."""
    if task not in folders:
        raise DamagedError(task)
    source, place = folders[task]
    if not _current(source, place, keys[task]):
        _publish(source, place, keys[task])
    return edited(source, place)


def to_read(store: Store, planned: Iterable[PlannedTask], out: Path) -> set[str]:
    """Names of tasks whose results will be read for publishing and reports; up-to-date folders aren't read again."""
    keys = {item.task.id.name: item.key for item in planned}
    folders = _published_folders(store, keys, out)
    return {
        *REPORTED_TASKS,
        *(task for task, (source, place) in folders.items() if not _current(source, place, keys[task])),
    }


def published(store: Store, planned: Iterable[PlannedTask], out: Path) -> bool:
    """Whether all published files equal those of the cached results."""
    keys = {item.task.id.name: item.key for item in planned}
    folders = _published_folders(store, keys, out)
    return "export" in folders and all(_current(*both, keys[task]) for task, both in folders.items())


def _published_folders(store: Store, keys: Mapping[str, str], out: Path) -> dict[str, tuple[Path, Path]]:
    """Task to the folder of its cached result that is published, and to its destination."""
    found = {}
    for task, (output, place) in PUBLISHED_OUTPUTS.items():
        manifest = store.find(task, keys[task]) if task in keys else None
        if manifest is not None and output in manifest.files:
            found[task] = store.folder(task, keys[task]) / manifest.files[output], out / place
    return found


def _current(source: Path, place: Path, key: str) -> bool:
    """Whether a published folder is from this result, with unchanged files except for the user's edits."""
    files = [path.relative_to(source) for path in source.rglob("*") if path.is_file()]
    return bool(files) and _is_from(place, key) and all(same_unless_edited(source / f, place / f) for f in files)


def _is_from(place: Path, key: str) -> bool:
    """Whether a folder was published from the result with this key."""
    stamp = place / STAMP_FILE
    return stamp.is_file() and stamp.read_text(errors="replace", encoding="utf-8") == key


def edited(source: Path, place: Path) -> list[Path]:
    """Published files of editable types that differ from the result: edited by a user (or damaged)."""
    pairs = [
        (source / path.relative_to(place), path)
        for path in sorted(place.rglob("*"))
        if path.suffix in USER_EDITABLE_SUFFIXES
    ]
    return [b for a, b in pairs if a.is_file() and not same_file(a, b) and a.read_bytes() != b.read_bytes()]


def _publish(source: Path, place: Path, key: str) -> None:
    """Copy a folder from the store (large files as hard links if possible); keeps edits of the same result."""
    fresh = place.with_name(f".{place.name}")
    shutil.rmtree(fresh, ignore_errors=True)
    copy_tree(source, fresh, link)
    for file in edited(source, place) if _is_from(place, key) else ():
        shutil.copyfile(file, fresh / file.relative_to(place))
    (fresh / STAMP_FILE).write_text(key, encoding="utf-8")
    swap(fresh, place)
