"""What comes before a survey's tiles: SLAM where it is asked for, import, and the cut; each redone if it must be.

A drive is what a vehicle brought home, in a `drive.toml` (docs/scale.md shows one): a video for SLAM where GPS is poor,
the scanner's sweeps, which its path places, and how to cut; or, instead of sweeps, a corridor that is there already.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict

from scan2sim.flows.commands import cut
from scan2sim.flows.commands.slam import slam_video
from scan2sim.flows.engine.lock import locked
from scan2sim.flows.recipes.settings import Settings
from scan2sim.flows.recipes.video import Video
from scan2sim.pipeline.errors import InputError, from_os_error
from scan2sim.pipeline.io import sweeps as io
from scan2sim.pipeline.io import toml
from scan2sim.pipeline.io.remote import is_remote, likeness
from scan2sim.pipeline.io.tile import sources_of
from scan2sim.pipeline.ranges import Buffer, Focal, Length, Pixels, Range, Voxel
from scan2sim.pipeline.step import Report, silent
from scan2sim.pipeline.store import Digests

Say = Callable[[str], None]
PREPARED = "prepared"


class _Strict(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class SweepsEntry(_Strict):
    """What is imported; as the options of `scan2sim import sweeps`."""

    folder: Path
    poses: Path | None = None
    extrinsics: Path | None = None
    times: Path | None = None
    photos: Path | None = None
    photo_times: Path | None = None
    camera: str = "auto"
    focal: Focal | None = None
    centre: tuple[Pixels, Pixels] | None = None
    max_range: Range = 50.0
    voxel: Voxel | None = None
    crs: str = "local"


class TilesEntry(_Strict):
    """How the corridor is cut; as the options of `scan2sim tile`."""

    length: Length = 100.0
    buffer: Buffer = 5.0


class Drive(_Strict):
    """All of `drive.toml`."""

    corridor: Path | None = None
    slam: Video | None = None
    sweeps: SweepsEntry | None = None
    tiles: TilesEntry = TilesEntry.model_validate({})


def survey_of(
    place: str | Path,
    target: str | Path,
    *,
    length: float | None = None,
    buffer: float | None = None,
    say: Say = print,
    report: Report = silent,
) -> str:
    """The `survey.toml` of a source: a survey itself, a corridor (`tile.toml`), or a drive (`drive.toml`).

    What has to be made of it is kept in the target, and made again only where what it is made of has changed.

    Args:
        place: a file, or a folder that holds one; in object storage a survey's folder.
        target: gets `prepared/` with `slam/`, `corridor/` and `survey/`, as needed.
        length, buffer: metres, how it is cut, if not as the drive says or as usual.
        say: told what was warned of.

    Raises:
        InputError: it is none of these, or says something impossible.
        ScanError: as SLAM, import and cut.
    """
    if is_remote(place):
        return str(place)
    source, out = Path(place), likeness(target)
    names = ("survey.toml", "drive.toml", "tile.toml")
    if source.is_dir():
        source = next((source / name for name in names if (source / name).is_file()), source)
    if not source.is_file():
        raise InputError(source, "there is no survey here", f"Name one of {', '.join(names)}, or a folder that has it")
    if source.name == "survey.toml":
        return str(source)
    with locked(out / PREPARED):
        digests = Digests(out / PREPARED / "digests.json")
        once = _Once(digests)
        corridor, entry = source, TilesEntry.model_validate({})
        if source.name == "drive.toml":
            drive = read_drive(source)
            entry = drive.tiles
            corridor = _corridor(drive, source, out / PREPARED, once, say, report)
        given = {"length": length, "buffer": buffer}
        entry = entry.model_copy(update={name: value for name, value in given.items() if value is not None})
        survey = _cut(corridor, out / PREPARED / "survey", entry, once, say, report)
        digests.save()
    return str(survey)


def read_drive(path: Path) -> Drive:
    """Read and check a `drive.toml`; its files are relative to it.

    Raises:
        InputError: naming the field.
    """
    absent = ("there is no drive here", "Name a drive.toml")
    drive = toml.read(path, Drive, absent=absent, fields="docs/scale.md lists the fields")
    if (drive.corridor is None) == (drive.sweeps is None):
        raise InputError(path, "says neither or both of `corridor` and `[sweeps]`", "Give one: what is to be cut")
    if drive.sweeps and not (drive.sweeps.poses or drive.slam):
        raise InputError(path, "has sweeps, but nothing that places them", "Give sweeps.poses, or [slam]")
    return drive


class _Once:
    """Makes what isn't there, or was made of something else."""

    def __init__(self, digests: Digests) -> None:
        self._digests = digests

    def __call__(self, folder: Path, version: int, sources: list[Path], options: Any, make: Callable[[], None]) -> None:
        """Make `folder`, unless code of the same version made it of the same sources with the same options."""
        contents = {str(path): self._digests(path) for path in sources}
        asked = json.dumps([version, contents, options], sort_keys=True, default=str)
        key = hashlib.sha256(asked.encode()).hexdigest()
        stamp = folder.with_name(f"{folder.name}.made")
        if folder.is_dir() and stamp.is_file() and stamp.read_text() == key:
            return
        make()
        try:
            stamp.write_text(key)
        except OSError as error:
            raise from_os_error(error, stamp) from None


def _corridor(drive: Drive, source: Path, out: Path, once: _Once, say: Say, report: Report) -> Path:
    """The corridor's `tile.toml`, by SLAM and import if need be."""
    here = source.parent
    if drive.corridor is not None:
        corridor = here / drive.corridor
        return corridor / "tile.toml" if corridor.is_dir() else corridor
    poses = None
    if drive.slam is not None:
        poses = _slam(drive.slam, here, out / "slam")
    assert drive.sweeps is not None
    return _sweeps(drive.sweeps, here, poses, out / "corridor", once, say, report)


def _slam(video: Video, here: Path, out: Path) -> Path:
    """The trajectory of a drive's video; its files are relative to `here`."""
    files = {name: here / value for name, value in video if isinstance(value, Path)}
    slam_video(Video.model_validate(video.model_dump(exclude_unset=True) | files), out, Settings())
    return out / "trajectory.csv"


def _sweeps(
    entry: SweepsEntry, here: Path, poses: Path | None, out: Path, once: _Once, say: Say, report: Report
) -> Path:
    place = poses or here / (entry.poses or "")
    files = sorted((here / entry.folder).glob("*")) + sorted((here / entry.photos).glob("*") if entry.photos else [])
    camera = Path(entry.camera) if entry.camera.endswith(".toml") else None
    rest = [here / path for path in (entry.extrinsics, entry.times, entry.photo_times, camera) if path is not None]

    def make() -> None:
        pictures = None
        if entry.photos is not None:
            shape = io.camera_of_photos(
                here / entry.photos, model="auto" if camera else entry.camera, focal=entry.focal, centre=entry.centre,
                file=camera and here / camera,
            )  # fmt: skip
            beside = io.photo_extrinsics(here / entry.extrinsics, here / entry.photos) if entry.extrinsics else None
            times = entry.photo_times and here / entry.photo_times
            pictures = io.Pictures(here / entry.photos, shape, times, extrinsics=beside)
        io.import_sweeps(
            here / entry.folder, place, out, photos=pictures, times=entry.times and here / entry.times,
            extrinsics=io.read_extrinsics(here / entry.extrinsics) if entry.extrinsics else None,
            max_range=entry.max_range, voxel=entry.voxel, crs=entry.crs, link=True, overwrite=True, warn=say,
            report=report,
        )  # fmt: skip

    once(out, io.VERSION, [place, *files, *rest], entry.model_dump(), make)
    return out / "tile.toml"


def _cut(corridor: Path, out: Path, entry: TilesEntry, once: _Once, say: Say, report: Report) -> Path:
    def make() -> None:
        cut.cut_survey(corridor, out, cut.Options(entry.length, entry.buffer), overwrite=True, report=report, warn=say)

    once(out, cut.VERSION, sources_of(corridor), entry.model_dump(), make)
    return out / "survey.toml"
