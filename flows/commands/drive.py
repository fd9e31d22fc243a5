"""Prepares a survey from a drive: SLAM, import of sweeps, cutting into tiles; repeats only what has changed."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from scan2sim.flows.commands.slam import check_sure, publish_path
from scan2sim.flows.engine.execution import Executor
from scan2sim.flows.engine.lock import locked
from scan2sim.flows.engine.planning import STORE, PlannedTask, drop_damaged, plan
from scan2sim.flows.pipelines.drive import Drive, build_graph
from scan2sim.pipeline.core.cache import Digests, Manifest, Store
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.remote import is_remote, local_copy

PREPARED, DRIVE = "prepared", "drive.toml"
LINKED_OUTPUTS = {"import_sweeps": "corridor", "cut": "survey"}
"""Step to the output that is linked into the folder `prepared/`."""


def survey_of(
    place: str | Path,
    target: str | Path,
    run: Executor,
    *,
    length: float | None = None,
    buffer: float | None = None,
    warn: Callable[[str], None] = lambda _: None,
) -> str:
    """Path of the `survey.toml` of a source: a survey itself, a corridor (`tile.toml`), or a drive (`drive.toml`).

    A survey made from a corridor or drive is cached in the target, and rebuilt when its inputs or settings change.

    Args:
        place: a file, or the folder that contains it; in object storage the folder of a survey.
        target: output folder; gets `prepared/` with `slam/`, `corridor/` and `survey/`, as needed.
        run: runs the steps.
        length, buffer: tile length and overlap in metres; default: those of the drive.
        warn: receives the warnings of the steps that ran.

    Raises:
        InputError: it is none of these, or has invalid content.
        LowConfidenceError: most of the trajectory is extrapolated; it is written, for inspection.
        ScanError: raised by SLAM, import or cutting.
    """
    if is_remote(place):
        return str(place)
    source, out = found(Path(place)), local_copy(target) / PREPARED
    if source.name == "survey.toml":
        return str(source)
    with locked(out):
        planned, store, digests = plan_drive(source, out, length=length, buffer=buffer)
        if drop_damaged(planned, store, {item.task.id.name for item in planned}):
            planned, store, digests = plan_drive(source, out, length=length, buffer=buffer)
        outcome = run(planned, store)
        if "georeference" in outcome.of_tile():
            publish_path(planned, outcome.of_tile(), store, out / "slam")
            _check_path(planned, outcome.of_tile(), out / "slam")
        outcome.check()
        for item in planned:
            for text in outcome.done[item.task.id].warnings if item.reason is not None else ():
                warn(text)
        folders = {item.task.id.name: store.folder(item.task.full_name, item.key) for item in planned}
        for name in LINKED_OUTPUTS.keys() & folders.keys():
            _link(folders[name] / LINKED_OUTPUTS[name], out / LINKED_OUTPUTS[name])
        store.sweep({item.task.id.name: item.key for item in planned})
        digests.save()
    return str(folders["cut"] / "survey" / "survey.toml")


def _check_path(planned: list[PlannedTask], done: dict[str, Manifest], slam: Path) -> None:
    """Raise a LowConfidenceError if the sweeps depend on a video trajectory that is mostly extrapolated.

    With `keep_unsure`, or fused with other sources, such a trajectory is accepted.
    """
    names = {item.task.id.name for item in planned}
    if "fuse" not in names and not any(getattr(item.task.params, "keep_unsure", False) for item in planned):
        remedy = "Add gps to [slam], fix the causes that slam.json lists, or set keep_unsure = true in [sweeps]"
        check_sure(done["georeference"].metrics["unsure_share"], slam, remedy)


def found(place: Path) -> Path:
    """The file of a source: `place` itself, or a survey.toml, drive.toml or tile.toml in that folder.

    Raises:
        InputError: there is none.
    """
    names = ("survey.toml", DRIVE, "tile.toml")
    if place.is_dir():
        place = next((place / name for name in names if (place / name).is_file()), place)
    if not place.is_file():
        raise InputError(place, "no survey found", f"Name a {', '.join(names)}, or a folder that contains one")
    return place


def plan_drive(
    source: Path, out: Path, *, length: float | None = None, buffer: float | None = None
) -> tuple[list[PlannedTask], Store, Digests]:
    """The plan of a drive, or of cutting a corridor; the cache of its results, and the digests of its sources.

    Raises:
        ScanError: the file can't be read, or has invalid content.
    """
    is_corridor = source.name != DRIVE
    drive = Drive(corridor=Path(source.name)) if is_corridor else Drive.read(source)
    given = {name: value for name, value in (("length", length), ("buffer", buffer)) if value is not None}
    drive = drive.model_copy(update={"tiles": drive.tiles.model_copy(update=given)})
    store = Store(out / STORE)
    digests = Digests(store.root / "digests.json")
    return plan(build_graph(drive, source.parent), store, digest=digests), store, digests


def _link(folder: Path, place: Path) -> None:
    """Create or update the symbolic link `place` to a result; without links, `place.txt` has the result's path."""
    if place.is_symlink():
        place.unlink()
    if place.exists():
        return
    path = os.path.relpath(folder, place.parent)
    try:
        place.symlink_to(path, target_is_directory=True)
    except OSError:  # exFAT, many network drives
        place.with_name(f"{place.name}.txt").write_text(f"{path}\n", encoding="utf-8")
