"""What comes before a survey's tiles: SLAM where it is asked for, import, and the cut; each redone if it must be."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from scan2sim.flows.commands.slam import check_sure, publish_path
from scan2sim.flows.engine.execution import Executor
from scan2sim.flows.engine.lock import locked
from scan2sim.flows.engine.planning import STORE, Planned, drop_damaged, plan
from scan2sim.flows.pipelines.drive import Drive, recipe
from scan2sim.pipeline.core.cache import Digests, Manifest, Store
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.io.remote import is_remote, likeness

PREPARED, DRIVE = "prepared", "drive.toml"
SHOWN = {"import_sweeps": "corridor", "cut": "survey"}
"""Of steps, the output that is shown beside the store, by a link."""


def survey_of(
    place: str | Path,
    target: str | Path,
    run: Executor,
    *,
    length: float | None = None,
    buffer: float | None = None,
    warn: Callable[[str], None] = lambda _: None,
) -> str:
    """The `survey.toml` of a source: a survey itself, a corridor (`tile.toml`), or a drive (`drive.toml`).

    What has to be made of it is kept in the target, and made again only where what it is made of has changed.

    Args:
        place: a file, or a folder that holds one; in object storage a survey's folder.
        target: gets `prepared/` with `slam/`, `corridor/` and `survey/`, as needed.
        run: runs the steps.
        length, buffer: metres, how it is cut, if not as the drive says or as usual.
        warn: gets what the steps that ran have warned of.

    Raises:
        InputError: it is none of these, or says something impossible.
        UnsureError: most of the path that SLAM found is unsure; it is there to be looked at.
        ScanError: as SLAM, import and cut.
    """
    if is_remote(place):
        return str(place)
    source, out = found(Path(place)), likeness(target) / PREPARED
    if source.name == "survey.toml":
        return str(source)
    with locked(out):
        planned, store, digests = plan_drive(source, out, length=length, buffer=buffer)
        if drop_damaged(planned, store, {item.node.id.name for item in planned}):
            planned, store, digests = plan_drive(source, out, length=length, buffer=buffer)
        outcome = run(planned, store)
        if "place" in outcome.of_tile():
            publish_path(planned, outcome.of_tile(), store, out / "slam")
            _check_path(planned, outcome.of_tile(), out / "slam")
        outcome.check()
        for item in planned:
            for text in outcome.done[item.node.id].warnings if item.reason is not None else ():
                warn(text)
        folders = {item.node.id.name: store.folder(item.node.full_name, item.key) for item in planned}
        for name in SHOWN.keys() & folders.keys():
            _link(folders[name] / SHOWN[name], out / SHOWN[name])
        store.sweep({item.node.id.name: item.key for item in planned})
        digests.save()
    return str(folders["cut"] / "survey" / "survey.toml")


def _check_path(planned: list[Planned], done: dict[str, Manifest], slam: Path) -> None:
    """Raise an UnsureError where the video's path is mostly unsure, alone, and not asked for all the same."""
    names = {item.node.id.name for item in planned}
    if "fuse" not in names and not any(getattr(item.node.params, "keep_unsure", False) for item in planned):
        remedy = "Give [slam] a gps, or mend what slam.json warns of; or say keep_unsure = true under [sweeps]"
        check_sure(done["place"].facts["unsure_share"], slam, remedy)


def found(place: Path) -> Path:
    """The file of a source: itself, or the one in a folder.

    Raises:
        InputError: there is none.
    """
    names = ("survey.toml", DRIVE, "tile.toml")
    if place.is_dir():
        place = next((place / name for name in names if (place / name).is_file()), place)
    if not place.is_file():
        raise InputError(place, "there is no survey here", f"Name one of {', '.join(names)}, or a folder that has it")
    return place


def plan_drive(
    source: Path, out: Path, *, length: float | None = None, buffer: float | None = None
) -> tuple[list[Planned], Store, Digests]:
    """What would run of a drive, or to cut a corridor; the store that keeps it, and what is known of its sources.

    Raises:
        ScanError: the file can't be read, or says something impossible.
    """
    whole = source.name != DRIVE
    drive = Drive(corridor=Path(source.name)) if whole else Drive.read(source)
    given = {name: value for name, value in (("length", length), ("buffer", buffer)) if value is not None}
    drive = drive.model_copy(update={"tiles": drive.tiles.model_copy(update=given)})
    store = Store(out / STORE)
    digests = Digests(store.root / "digests.json")
    return plan(recipe(drive, source.parent), store, digest=digests), store, digests


def _link(folder: Path, place: Path) -> None:
    """Have a link lead to a result."""
    if place.is_symlink():
        place.unlink()
    if not place.exists():
        place.symlink_to(os.path.relpath(folder, place.parent), target_is_directory=True)
