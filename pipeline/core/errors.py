"""Errors for the user: each names the file or setting, the cause and the remedy.

`EXIT_CODES` maps them to exit codes of the command and, for services, to HTTP statuses.
"""

from __future__ import annotations

import errno
from pathlib import Path

REMEDY_REBUILD = "Run again: only this result is rebuilt"
REMEDY_RETRY = "Run again to retry what failed; run.log has the details"


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
    """Text with non-printable characters escaped: a file name may hold terminal control codes or line breaks."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


class SettingError(ScanError):
    """A setting, option or parameter that doesn't exist or is out of range."""


class InputError(ScanError):
    """An input file that is missing, unreadable or inconsistent."""


class DataError(ScanError):
    """Readable input from which no world can be made (too few points, no overlap)."""


class StepError(ScanError):
    """A step that failed, and so did its retry and its fallback."""


class DamagedError(StepError):
    """A cached result with changed bytes; `where` is the full name of its task, which runs again."""

    def __init__(
        self, where: str | Path, cause: str = "its cached result is damaged", remedy: str = REMEDY_REBUILD
    ) -> None:
        super().__init__(where, cause, remedy)


class SpaceError(ScanError):
    """The disk is full, or writing is not permitted."""


class BusyError(ScanError):
    """Another run is using the same folder."""


class LowConfidenceError(ScanError):
    """The result was written, but most of it is extrapolated, not measured."""


class IncompleteError(ScanError):
    """The world is finished, but side products (roads, images, the report) failed; `where` is the world's folder."""

    def __init__(self, where: str | Path, cause: str, remedy: str = REMEDY_RETRY) -> None:
        super().__init__(where, cause, remedy)


class UnavailableError(ScanError):
    """A package, program or device that is missing, or doesn't run on this machine."""


class WorkerError(UnavailableError):
    """A worker of a cluster that can't run the steps of a run: it has other versions, or another disk."""


# exception: (exit code, HTTP status, meaning)
EXIT_CODES: dict[type[BaseException], tuple[int, int, str]] = {
    SettingError: (2, 422, "a setting or option is wrong"),
    InputError: (3, 422, "an input file is missing, unreadable or wrong"),
    DataError: (4, 422, "the input is readable, but no world can be made from it"),
    StepError: (5, 500, "a step failed, and so did its retry and fallback"),
    SpaceError: (6, 507, "the disk is full, or writing is not permitted"),
    UnavailableError: (7, 501, "a required package, program or device is missing, or doesn't run here"),
    BusyError: (8, 409, "another run is using the same folder"),
    LowConfidenceError: (9, 422, "the result was written, but most of it is extrapolated, not measured"),
    IncompleteError: (10, 500, "the world is finished, but a side product failed (roads, images, the report, ...)"),
    KeyboardInterrupt: (130, 499, "interrupted; finished steps are kept"),
}

INTERRUPTED = "Interrupted; finished steps are kept, the same command resumes from there."


def exit_code(error: BaseException) -> int:
    """The command's exit code for an error; 1 for one that is not in the table."""
    for kind, (code, _, _) in EXIT_CODES.items():
        if isinstance(error, kind):
            return code
    return 1


def http_status(error: BaseException) -> int:
    """A service's HTTP status for an error; 500 for one that is not in the table."""
    for kind, (_, status, _) in EXIT_CODES.items():
        if isinstance(error, kind):
            return status
    return 500


def from_exception(error: Exception, where: str, folder: Path) -> ScanError:
    """Convert an exception of `where` (a step or side product that writes into `folder`) into an error for the user."""
    if isinstance(error, ScanError):
        return error
    if isinstance(error, OSError):
        return from_os_error(error, folder)
    if isinstance(error, UnicodeEncodeError) and is_about_a_file_name(error):
        return from_name_error(error)
    if isinstance(error, MemoryError):
        return StepError(where, "ran out of memory", "Use a smaller tile, or larger voxels")
    cause = f"failed unexpectedly ({type(error).__name__}: {error})"
    return StepError(where, cause, "The log has the traceback; please report it as a bug")


def is_about_a_file_name(error: UnicodeEncodeError) -> bool:
    """Whether text can't be written as UTF-8 because of a file name in it that isn't (in Latin-1, say)."""
    return "\udc80" <= error.object[error.start] <= "\udcff"


def from_name_error(error: UnicodeEncodeError) -> InputError:
    """Convert an error for which `is_about_a_file_name` holds."""
    around = error.object[max(0, error.start - 60) : error.start + 60]
    return InputError(around, "is a file name that isn't UTF-8", "Rename it (`convmv` renames many files)")


def from_os_error(error: OSError, path: str | Path) -> ScanError:
    """Convert an `OSError` into an error that names the path; a `SpaceError` if the disk is full or not writable."""
    where = error.filename or path
    partial_write = error.errno is None and "written" in str(error)  # numpy's error for a full disk
    if error.errno in (errno.ENOSPC, errno.EDQUOT) or partial_write:
        return SpaceError(where, "no space left on the disk", "Free some space and run again; finished steps are kept")
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return SpaceError(where, "no permission to write", "Choose another --out, or change its permissions")
    if error.errno in (errno.EEXIST, errno.ENOTDIR, errno.EISDIR):
        return SettingError(where, str(error.strerror), "Choose another path: something else exists here")
    return InputError(where, str(error.strerror or error), "Check that the path exists and can be read")
