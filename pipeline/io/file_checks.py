"""Checks before a path is opened: folders, pipes and devices are rejected (reading a pipe could block for ever).

`check_data` also recognizes what is often found in place of a data file: nothing, a web page, an archive.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from scan2sim.pipeline.core.errors import InputError, from_os_error

NOT_FOUND = "file not found"
CHECK_PATH = "Check the path"
NO_PERMISSION = "can't be read: no permission"
HEAD_BYTES = 1000
"""Bytes by which the content of a file is recognized."""
IMPOSTORS: tuple[tuple[tuple[bytes, ...], str, str], ...] = (
    (
        (b"version https://git-lfs.github.com/spec/",),
        "is a Git LFS pointer, not the file that it stands for",
        "Fetch the file with `git lfs pull`",
    ),
    (
        (b"<!doctype html", b"<html", b"<head"),
        "is a web page, not the file",
        "Download it from the file's own address",
    ),
    (
        (b"<?xml", b"<error"),
        "is an XML document, perhaps the error message of a server",
        "Read the reason in it (no access, an expired link), then download the file by an address that works",
    ),
    ((b"PK\x03\x04",), "is a ZIP archive", "Unpack it first"),
    ((b"\x1f\x8b",), "is compressed by gzip", "Unpack it first"),
    ((b"7z\xbc\xaf\x27\x1c", b"Rar!\x1a\x07"), "is an archive", "Unpack it first"),
)
"""Beginnings of files (letters in either case), what such a file is, and what to do about it."""


def problem(path: Path) -> str | None:
    """Why a path can't be read as a file (`NOT_FOUND`, "is a folder, not a file", ...); None if it can."""
    try:
        if path.is_file():
            return None if os.access(path, os.R_OK) else NO_PERMISSION
        if path.is_dir():
            return "is a folder, not a file"
        if path.exists():
            return "is a pipe or device, not a file"
        if path.is_symlink():
            return f"is a link that leads nowhere (to {path.readlink()})"
    except PermissionError:
        return "can't be read: no permission for its folder"
    return NOT_FOUND


def check(path: Path, remedy: str = CHECK_PATH) -> Path:
    """Check that `path` is a regular file, and return it.

    Raises:
        InputError: it doesn't exist, may not be read, or is a folder, pipe or device.
    """
    cause = problem(path)
    if cause is not None:
        raise InputError(path, cause, "Change its permissions" if NO_PERMISSION in cause else remedy)
    return path


def check_data(path: Path) -> Path:
    """Check that `path` is a regular file with data, by its first bytes, and return it.

    Raises:
        InputError: as `check`, or it is empty, a web page, a Git LFS pointer or an archive.
    """
    with check(path).open("rb") as file:
        head = file.read(HEAD_BYTES)
    if not head:
        raise InputError(path, "is empty (0 bytes)", "Copy or export it again")
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip().lower()
    for beginnings, cause, remedy in IMPOSTORS:
        if text.startswith(tuple(beginning.lower() for beginning in beginnings)):
            raise InputError(path, cause, remedy)
    if not head.strip(b"\0"):
        raise InputError(path, "contains only zeros", "Copy or export it again")
    return path


def hidden(path: Path) -> bool:
    """Whether a file is hidden: macOS writes a `._NAME.SUFFIX` beside each file on exFAT and network drives."""
    return path.name.startswith(".")


def natural_order(name: str) -> list[int | str]:
    """Sort key of a file's name by which 2 comes before 10."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name)]


def files(folder: Path) -> list[Path]:
    """Files in a folder that aren't hidden, sorted by name.

    Raises:
        InputError: it doesn't exist, is no folder, or may not be read.
    """
    try:
        return sorted(path for path in folder.iterdir() if path.is_file() and not hidden(path))
    except PermissionError:
        raise InputError(folder, NO_PERMISSION, "Change its permissions") from None
    except NotADirectoryError:
        raise InputError(folder, "is a file, not a folder", CHECK_PATH) from None
    except FileNotFoundError:
        raise InputError(folder, "folder not found", CHECK_PATH) from None


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


def copy_tree(source: Path, target: Path, copy: Callable[[str, str], object] = shutil.copyfile) -> None:
    """Copy all files below a folder by `copy(source, target)`, into folders that may exist.

    Contents only: many network drives refuse the permissions and times that `shutil.copytree` copies, too.
    """
    target.mkdir(parents=True, exist_ok=True)
    for entry in sorted(source.iterdir()):
        if entry.is_dir():
            copy_tree(entry, target / entry.name, copy)
        else:
            copy(str(entry), str(target / entry.name))


def copy_with_time(source: Path, target: Path) -> None:
    """Copy a file with its modification time, if the disk accepts it."""
    shutil.copyfile(source, target)
    stat = source.stat()
    with suppress(PermissionError):
        os.utime(target, ns=(stat.st_atime_ns, stat.st_mtime_ns))


def symlink_or_copy(source: Path, target: Path) -> None:
    """Make `target` a symbolic link to `source`, or a copy where there are none (exFAT, many network drives)."""
    try:
        target.symlink_to(source.resolve())
    except FileExistsError:
        raise
    except OSError:
        shutil.copyfile(source, target)


def link_or_copy(source: Path, target: Path) -> None:
    """Make `target` a hard link to `source` (neither may be changed afterwards), or a copy where links fail."""
    try:
        os.link(source, target)
    except OSError:  # another disk, or a file system without links
        shutil.copyfile(source, target)
