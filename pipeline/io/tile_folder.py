"""Output folders of importers: created atomically, with files copied or linked into them."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

from scan2sim.pipeline.core.errors import InputError, SettingError, from_os_error
from scan2sim.pipeline.core.paths import new_folder
from scan2sim.pipeline.io import file_checks

MARKER_FILE = {"tile": "tile.toml", "survey": "survey.toml", "world": "metadata.json", "page": "view.js",
               "set of variations": "variations.json"}  # fmt: skip
"""File by which a folder of each kind is recognized."""


MAX_PREFIX = 50
"""Maximum length of the temporary folder's prefix in characters: names of files have at most 255 bytes."""
Kind = Literal["tile", "survey", "world", "page", "set of variations"]


def check_target(out: Path, overwrite: bool = False, kind: Kind = "tile") -> None:
    """Check that `tile_folder` may create a folder, before a long computation.

    Raises:
        SettingError: `out` is a file, or a folder that isn't empty and may not be overwritten.
    """
    if out.exists() and not out.is_dir():
        raise SettingError(out, "is a file, not a folder", "Choose another folder")
    if out.is_dir() and any(out.iterdir()) and not overwrite:
        raise SettingError(out, "exists and is not empty", "Choose a new folder, or replace it with --overwrite")
    if out.is_dir() and any(out.iterdir()) and not (out / MARKER_FILE[kind]).is_file():
        raise SettingError(out, f"is not a {kind}, so it is not overwritten", f"Choose a new folder, or a {kind}'s")


@contextmanager
def tile_folder(out: Path, overwrite: bool = False, kind: Kind = "tile") -> Iterator[Path]:
    """Temporary folder beside `out`: renamed to `out` when the block succeeds, deleted when it raises.

    A mounted disk and the current folder can't be replaced, so their content is.

    Args:
        out: the folder to create.
        overwrite: replace an existing folder of the same kind.
        kind: kind of content; only folders with its marker file are overwritten.

    Raises:
        SettingError: as `check_target`; or the new folder has links to files of the one that it would replace.
        SpaceError: the disk is full or not writable.
    """
    out = Path(out).resolve()
    check_target(out, overwrite, kind)
    stays = out.is_dir() and (out.is_mount() or out.samefile("."))
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        work = new_folder(out if stays else out.parent, f".{out.name}-"[:MAX_PREFIX])
    except OSError as error:
        raise from_os_error(error, out) from error
    try:
        yield work
        if out.exists():
            _check_links(work, out)
            old = new_folder(work.parent, ".old-")
            if stays:
                _move_content(out, old, [old, work])
                _move_content(work, out)
            else:
                out.replace(old)
                work.replace(out)
            shutil.rmtree(old, ignore_errors=True)  # NFS can't delete the folder of a file that a program has open
        else:
            work.replace(out)
    except OSError as error:
        raise from_os_error(error, out) from error
    finally:
        shutil.rmtree(work, ignore_errors=True)


def _check_links(work: Path, out: Path) -> None:
    """Check that a new folder has no links to files of the folder that it replaces, which would be lost."""
    for link in (path for path in work.rglob("*") if path.is_symlink()):
        source = link.resolve()
        if source.is_relative_to(out) and not source.is_relative_to(work):
            remedy = "Leave out --link, or choose another --out"
            raise SettingError(out, f"contains {source}, which would be lost", remedy)


def _move_content(folder: Path, target: Path, without: Sequence[Path] = ()) -> None:
    for path in list(folder.iterdir()):
        if path not in without:
            path.replace(target / path.name)


def add_file(source: Path, folder: Path, name: str, link: bool = False) -> str:
    """Copy (or symlink, by absolute path) `source` to `folder/name`; returns `name`.

    Raises:
        InputError: the source is missing, the name is already used by another file, or can't be written in a tile.toml.
    """
    target = folder / name
    try:
        name.encode()
    except UnicodeEncodeError:
        raise InputError(source, "has a name that isn't UTF-8", "Rename it (`convmv` renames many files)") from None
    file_checks.check(source, "Check the path, or remove the entry that names it")
    if target.exists() or target.is_symlink():
        raise InputError(source, f"is the second file with the name {name} in the tile", "Rename one of them")
    target.parent.mkdir(parents=True, exist_ok=True)
    if link:
        file_checks.symlink_or_copy(source, target)
    else:
        shutil.copyfile(source, target)
    return name


def names_in(subfolder: str, files: Sequence[Path], base: Path) -> list[str]:
    """Names in a subfolder of the tile of files below `base`; not `photos/photos/` if all are in one of its name."""
    names = [without_parents(str(file.relative_to(base) if file.is_relative_to(base) else file)) for file in files]
    if all(name.startswith(f"{subfolder}/") for name in names):
        return names
    return [f"{subfolder}/{name}" for name in names]


def without_parents(name: str) -> str:
    """A relative file name inside the tile's folder: `../a/b.jpg` and `/a/b.jpg` become `a/b.jpg`."""
    return "/".join(part for part in Path(name).parts if part not in ("..", ".", Path(name).anchor))
