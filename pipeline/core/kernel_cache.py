"""Where numba keeps compiled kernels if it can write neither beside the code nor in the user's cache folder.

As in a container that runs as another user than its image's, or after an installation by root for a user without a home
folder: there numba fails when a kernel is declared, and with it every command.
"""

from __future__ import annotations

import os
import stat
from collections.abc import MutableMapping
from contextlib import suppress
from pathlib import Path
from typing import Any

VARIABLE = "NUMBA_CACHE_DIR"


def choose(environment: MutableMapping[str, str] = os.environ, code: Path = Path(__file__).parent) -> None:
    """Set numba's cache folder to one in the temporary folder if numba's own choices can't be written.

    Args:
        environment: read by numba when it is imported, and passed on to child processes.
        code: folder of a kernel's module.
    """
    if environment.get(VARIABLE) or _can_write(code / "__pycache__"):
        return
    with suppress(RuntimeError):  # the user has no home folder
        if _can_write(_users(environment) / "numba"):
            return
    with suppress(OSError):  # no temporary folder either: numba says what it needs
        environment[VARIABLE] = str(_own_folder())


def run_without_space() -> None:
    """Let kernels run that numba can't keep, as its folder's disk is full or over quota: they are compiled again."""
    from numba.core.caching import Cache

    save = Cache.save_overload

    def save_if_possible(self: Any, signature: Any, data: Any) -> None:
        with suppress(OSError):
            save(self, signature, data)  # type: ignore[no-untyped-call]

    Cache.save_overload = save_if_possible  # type: ignore[method-assign]


def _users(environment: MutableMapping[str, str]) -> Path:
    """The user's cache folder."""
    return Path(environment.get("XDG_CACHE_HOME") or Path(environment.get("HOME") or Path("~").expanduser()) / ".cache")


def _can_write(folder: Path) -> bool:
    """Whether files can be created in a folder, which may have to be created first."""
    try:
        place = next(parent for parent in (folder, *folder.parents) if parent.exists())
    except PermissionError:  # below another user's folder, such as /root
        return False
    return place.is_dir() and os.access(place, os.W_OK | os.X_OK)


def _own_folder() -> Path:
    """A folder that no other user can write: kernels are code."""
    import tempfile

    folder = Path(tempfile.gettempdir()) / f"scan2sim-kernels-{os.getuid()}"
    with suppress(FileExistsError):
        folder.mkdir(0o700)
    found = folder.lstat()
    if stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022:
        return folder
    return Path(tempfile.mkdtemp(prefix="scan2sim-kernels-"))
