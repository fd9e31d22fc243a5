"""Checks before a path is opened: folders, pipes and devices are refused (reading a pipe could block for ever)."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from scan2sim.pipeline.core.errors import InputError, from_os_error

NOT_FOUND = "file not found"
CHECK_PATH = "Check the path"


def problem(path: Path) -> str | None:
    """Why a path can't be read as a file (`NOT_FOUND`, "is a folder, not a file", ...); None if it can."""
    if path.is_file():
        return None
    if path.is_dir():
        return "is a folder, not a file"
    if path.exists():
        return "is a pipe or device, not a file"
    return NOT_FOUND


def check(path: Path, remedy: str = CHECK_PATH) -> Path:
    """Check that `path` is a regular file, and return it.

    Raises:
        InputError: it doesn't exist, or is a folder, pipe or device.
    """
    cause = problem(path)
    if cause is not None:
        raise InputError(path, cause, remedy)
    return path


def lines(path: Path, remedy: str = CHECK_PATH) -> list[str]:
    """The lines of a text file; bytes that aren't UTF-8 become replacement characters, which no number contains.

    Raises:
        InputError: as `check`.
    """
    return check(path, remedy).read_text(encoding="utf-8-sig", errors="replace").splitlines()


def make_folder(folder: Path) -> None:
    """Create a folder and its parents unless it exists.

    Raises:
        SpaceError: the disk is full or not writable.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise from_os_error(error, folder) from error


def link_or_copy(source: Path, target: Path) -> None:
    """Make `target` a hard link to `source` (neither may be changed afterwards), or a copy where links fail."""
    try:
        os.link(source, target)
    except OSError:  # another disk, or a file system without links
        shutil.copyfile(source, target)
