"""What may be opened as a file: no folder, and no pipe or device, which would be waited on for ever."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from scan2sim.pipeline.core.errors import InputError, from_os_error

PUT_THERE = "Put it there, or mend the name"


def problem(path: Path) -> str | None:
    """Why a path can't be read as a file ("is missing", "is a folder", ...); None if it can."""
    if path.is_file():
        return None
    if path.is_dir():
        return "is a folder, not a file"
    if path.exists():
        return "is a pipe or device, not a file"
    return "is missing"


def check(path: Path, remedy: str = PUT_THERE) -> Path:
    """`path`, which is a file.

    Raises:
        InputError: it is none.
    """
    cause = problem(path)
    if cause is not None:
        raise InputError(path, cause, remedy)
    return path


def lines(path: Path, remedy: str = PUT_THERE) -> list[str]:
    """The lines of a text file; bytes that are no UTF-8 become question marks, which no number has.

    Raises:
        InputError: it is no file.
    """
    return check(path, remedy).read_text(encoding="utf-8-sig", errors="replace").splitlines()


def make_folder(folder: Path) -> None:
    """Make a folder, and those above it, unless it is there.

    Raises:
        SpaceError: the disk is full or may not be written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise from_os_error(error, folder) from error


def pass_on(source: Path, target: Path) -> None:
    """`target` as a hard link of `source`, which neither may change any more; a copy where links can't be made."""
    try:
        os.link(source, target)
    except OSError:  # another disk, or a file system without links
        shutil.copyfile(source, target)
