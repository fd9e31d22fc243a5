"""Locks a folder, so that only one run at a time uses it."""

from __future__ import annotations

import errno
import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from scan2sim.pipeline.core.errors import BusyError, UnavailableError, from_os_error

LOCKED = (errno.EWOULDBLOCK, errno.EACCES)
"""Errors of a lock that another process holds; the second one of network drives."""


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Create a folder and hold its lock while the context is active.

    Raises:
        BusyError: another run holds the lock.
        UnavailableError: the disk has no locks: two runs would damage each other's results.
        SpaceError: the folder can't be created.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = open(folder / ".lock", "w", encoding="utf-8")
    except OSError as error:
        raise from_os_error(error, folder) from None
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno not in LOCKED:
                raise UnavailableError(
                    folder, f"files can't be locked on this disk ({error.strerror})",
                    "Choose an --out on another disk, or mount this one with locks (Lustre: -o flock, NFS: lockd)",
                ) from None  # fmt: skip
            raise BusyError(
                folder, "another run is using this folder", "Wait until it ends, or choose another --out"
            ) from None
        yield
