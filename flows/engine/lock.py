"""Locks a folder, so that only one run at a time uses it."""

from __future__ import annotations

import errno
import fcntl
import os
import platform
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import FileIO
from pathlib import Path

from scan2sim.pipeline.core.errors import BusyError, UnavailableError, from_os_error
from scan2sim.pipeline.core.mounts import MOUNTED, mount_of

LOCKED = (errno.EWOULDBLOCK, errno.EACCES)
"""Errors of a lock that another process holds; the second one of network drives."""


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Create a folder and hold its lock while the context is active.

    Raises:
        BusyError: another run holds the lock; names its machine and process.
        UnavailableError: the disk has no locks: two runs would damage each other's results.
        SpaceError: the folder can't be created.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = FileIO(folder / ".lock", "a+")  # keeps what another run has written
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
            raise _busy(folder, file) from None
        with suppress(OSError):  # a full disk
            file.truncate(0)
            file.write(f"{platform.node()}, process {os.getpid()}, since {time.strftime('%F %T %Z')}".encode())
            os.fsync(file.fileno())  # other machines read it, which NFS shows only what has reached the server
        yield


def warning_of_local_locks(folder: Path, mounted: Path = MOUNTED) -> str | None:
    """Warning if locks of a network drive don't keep runs on other machines away; None if they do."""
    mount = mount_of(folder, mounted)
    if mount is None or not mount.is_network:
        return None
    options = mount.options
    if not {"nolock", "localflock", "nobrl"} & options.keys() and options.get("local_lock", "none") not in (
        "all",
        "flock",
    ):
        return None
    return (
        f"{folder}: locks on this {mount.kind} drive hold for one machine only: two runs on two machines would damage "
        "each other's results. Start one at a time, or mount it with locks (NFS: without nolock and local_lock; "
        "Lustre: flock, not localflock; CIFS: without nobrl)"
    )


def _busy(folder: Path, file: FileIO) -> BusyError:
    """The error that names the run which holds a lock."""
    holder = ""
    with suppress(OSError):
        file.seek(0)
        holder = file.read(1000).decode(errors="replace")
    remedy = "Wait until it ends, or choose another --out"
    if holder and not holder.startswith(f"{platform.node()},"):
        remedy += f". Network drives keep the lock of a lost machine: if that one is lost, delete {folder / '.lock'}"
    return BusyError(folder, f"another run is using this folder{holder and f' ({holder})'}", remedy)
