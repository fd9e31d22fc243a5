"""What can go wrong, said once: every error names the file, the cause and the remedy.

`EXIT_CODES` is the one table that turns errors into exit codes of the command (and, for the
services, HTTP statuses).
"""

from __future__ import annotations

import errno
from pathlib import Path

REBUILT = "Run again: it is rebuilt, and nothing else"
RETRIED = "Run again to retry what failed; run.log has the details"


class ScanError(Exception):
    """An error that the user can act on.

    Args:
        where: the file (or setting) that the error is about.
        cause: what is wrong with it.
        remedy: what to do about it.
    """

    def __init__(self, where: str | Path, cause: str, remedy: str) -> None:
        super().__init__(where, cause, remedy)  # args must survive pickling between processes
        self.where = printable(str(where))
        self.cause = printable(cause)
        self.remedy = printable(remedy)

    def __str__(self) -> str:
        return f"{self.where}: {self.cause}. {self.remedy}"


def printable(text: str) -> str:
    """Text, which may hold names of files, with codes for what would steer a terminal or begin a line."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


class SettingError(ScanError):
    """A setting, option or parameter that doesn't exist or is out of range."""


class InputError(ScanError):
    """A file of the tile that is missing, unreadable, or says something impossible."""


class DataError(ScanError):
    """Readable input from which no world can be made (too few points, nothing overlaps)."""


class StepError(ScanError):
    """A step that failed, its retry and its fallback included."""


class DamagedError(StepError):
    """A kept result whose bytes aren't as they were made; `where` is the full name of its node, which is run again."""

    def __init__(self, where: str | Path, cause: str = "its kept result is damaged", remedy: str = REBUILT) -> None:
        super().__init__(where, cause, remedy)


class SpaceError(ScanError):
    """The disk is full or may not be written to."""


class BusyError(ScanError):
    """Another run is at work in the same place."""


class UnsureError(ScanError):
    """What came out is there, but most of it was guessed, not seen."""


class IncompleteError(ScanError):
    """The world is finished, but side products (roads, pictures, the report) failed; `where` is the world's folder."""

    def __init__(self, where: str | Path, cause: str, remedy: str = RETRIED) -> None:
        super().__init__(where, cause, remedy)


class UnavailableError(ScanError):
    """Something that is not installed or can't run on this machine."""


# exception: (exit code, HTTP status, meaning)
EXIT_CODES: dict[type[BaseException], tuple[int, int, str]] = {
    SettingError: (2, 422, "a setting or option is wrong"),
    InputError: (3, 422, "an input file is missing, unreadable or wrong"),
    DataError: (4, 422, "the input is readable, but no world can be made from it"),
    StepError: (5, 500, "a step failed, its retry and fallback included"),
    SpaceError: (6, 507, "the disk is full or can't be written to"),
    UnavailableError: (7, 501, "something needed is not installed or can't run here"),
    BusyError: (8, 409, "another run is at work in the same folder"),
    UnsureError: (9, 422, "the result is there, but most of it was guessed, not seen"),
    IncompleteError: (10, 500, "the world is finished, but a side product failed (roads, pictures, the report, ...)"),
    KeyboardInterrupt: (130, 499, "interrupted; what was finished is kept"),
}

INTERRUPTED = "Interrupted; what was finished is kept, the same command goes on from there."


def exit_code(error: BaseException) -> int:
    """The command's exit code for an error; 1 for one that the table doesn't know."""
    for kind, (code, _, _) in EXIT_CODES.items():
        if isinstance(error, kind):
            return code
    return 1


def http_status(error: BaseException) -> int:
    """A service's HTTP status for an error; 500 for one that the table doesn't know."""
    for kind, (_, status, _) in EXIT_CODES.items():
        if isinstance(error, kind):
            return status
    return 500


def from_exception(error: Exception, where: str, folder: Path) -> ScanError:
    """Turn any exception of `where`, a step or a side product that writes into `folder`, into an error for the user."""
    if isinstance(error, ScanError):
        return error
    if isinstance(error, OSError):
        return from_os_error(error, folder)
    if isinstance(error, MemoryError):
        return StepError(where, "ran out of memory", "Use a smaller tile, or larger voxels")
    cause = f"failed unexpectedly ({type(error).__name__}: {error})"
    return StepError(where, cause, "The log holds the details; please report it")


def from_os_error(error: OSError, path: str | Path) -> ScanError:
    """Turn an operating system's refusal to write into a `SpaceError` that names the path."""
    where = error.filename or path
    partial_write = error.errno is None and "written" in str(error)  # as numpy tells of a full disk
    if error.errno in (errno.ENOSPC, errno.EDQUOT) or partial_write:
        return SpaceError(where, "no space left on the disk", "Free some space and run again; finished steps are kept")
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return SpaceError(where, "may not be written to", "Choose another --out, or change its permissions")
    if error.errno in (errno.EEXIST, errno.ENOTDIR, errno.EISDIR):
        return SettingError(where, str(error.strerror), "Name another path: there is something else in its place")
    return InputError(where, str(error.strerror or error), "Check that the path exists and can be read")
