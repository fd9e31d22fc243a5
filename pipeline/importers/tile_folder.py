"""What importers share: a tile's or survey's folder appears whole or not at all; files are copied or linked into it."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

from scan2sim.pipeline.core.errors import InputError, SettingError, from_os_error
from scan2sim.pipeline.io import file_checks

MARK = {"tile": "tile.toml", "survey": "survey.toml", "world": "metadata.json", "page": "view.js"}
"""Of what is made, the file by which it is known."""


@contextmanager
def tile_folder(
    out: Path, overwrite: bool = False, kind: Literal["tile", "survey", "world", "page"] = "tile"
) -> Iterator[Path]:
    """A temporary folder beside `out` that takes its place when the block ends well, and is removed otherwise.

    Args:
        out: the folder.
        overwrite: replace one that holds a tile (or what `kind` says).
        kind: what is made; its file marks a folder that may be overwritten.

    Raises:
        SettingError: `out` exists, holds something, and `overwrite` is false; or it is a file.
        SpaceError: the disk is full or may not be written to.
    """
    out = Path.cwd() / out
    if out.exists() and not out.is_dir():
        raise SettingError(out, "is a file, not a folder", "Name another folder")
    if out.is_dir() and any(out.iterdir()) and not overwrite:
        raise SettingError(out, "exists and is not empty", "Name a new folder, or have it overwritten: --overwrite")
    if out.is_dir() and any(out.iterdir()) and not (out / MARK[kind]).is_file():
        raise SettingError(out, f"is no {kind}, and is not overwritten", f"Name a new folder, or a {kind}'s")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
    except OSError as error:
        raise from_os_error(error, out) from error
    try:
        work.chmod(0o755)  # mkdtemp makes it private
        yield work
        if out.exists():
            old = Path(tempfile.mkdtemp(prefix=f".{out.name}-old-", dir=out.parent))
            out.replace(old)
            work.replace(out)
            shutil.rmtree(old)
        else:
            work.replace(out)
    except OSError as error:
        raise from_os_error(error, out) from error
    finally:
        shutil.rmtree(work, ignore_errors=True)


def place(source: Path, folder: Path, name: str, link: bool = False) -> str:
    """Copy (or link, by absolute path) `source` to `folder/name`; returns `name`.

    Raises:
        InputError: the source is missing, or another file has already taken the name.
    """
    target = folder / name
    file_checks.check(source, "Put it there, or leave out what names it")
    if target.exists() or target.is_symlink():
        raise InputError(source, f"is the second file to be called {name} in the tile", "Rename one of them")
    target.parent.mkdir(parents=True, exist_ok=True)
    if link:
        target.symlink_to(source.resolve())
    else:
        shutil.copyfile(source, target)
    return name


def without_parents(name: str) -> str:
    """A file name that stays in the tile's folder: `../a/b.jpg` and `/a/b.jpg` become `a/b.jpg`."""
    return "/".join(part for part in Path(name).parts if part not in ("..", ".", Path(name).anchor))
