"""Locks a folder, so that only one run at a time uses it."""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from scan2sim.pipeline.core.errors import BusyError, from_os_error


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Create a folder and hold its lock while the context is active.

    Raises:
        BusyError: another run holds the lock.
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
        except BlockingIOError:
            raise BusyError(
                folder, "another run is using this folder", "Wait until it ends, or choose another --out"
            ) from None
        yield
