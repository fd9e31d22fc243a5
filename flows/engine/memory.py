"""How much memory a step needs, and a machine's memory shared out among the steps that run on it."""

from __future__ import annotations

import fcntl
import os
import re
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from scan2sim.pipeline.core.errors import SettingError, UnavailableError, from_os_error
from scan2sim.pipeline.io.images.image import SUFFIXES

if TYPE_CHECKING:
    from scan2sim.flows.engine.planning import Planned
    from scan2sim.pipeline.core.cache import Store

SLOT = 0.25  # GB; memory is shared out in pieces of it
LARGEST = 20_000  # GB, of what steps may need together
PAUSE = 0.2  # seconds between looks for free memory


def need(item: Planned, store: Store) -> float:
    """GB that a node is expected to need at its peak, from the sizes of what it reads."""
    least, share = item.node.step.memory
    # photos are read one after the other, and are no matter of the whole
    sizes = [_size(path) for path in item.inputs(store).values() if path.suffix.lower() not in SUFFIXES]
    return least + share * sum(sizes) / 1e9


def _size(path: Path) -> int:
    if path.is_dir():
        return 0  # depth maps, pages: one at a time
    return path.stat().st_size if path.exists() else 0


def parse(text: str | None) -> float | None:
    """GB of "20GB", "800 MB" or "20"; None of None.

    Raises:
        SettingError: it is none.
    """
    if text is None:
        return None
    match = re.fullmatch(r"\s*(\d{1,9}(?:\.\d{1,9})?)\s*(GB|G|MB|M)?\s*", text, re.IGNORECASE)
    size = float(match[1]) * (1e-3 if (match[2] or "G").upper().startswith("M") else 1) if match else 0.0
    if not 0 < size <= LARGEST:
        raise SettingError("--memory", f"`{text[:40]}` is no amount of memory", "Write 20GB, or 800MB")
    return size


@contextmanager
def share(total: float | None, gigabytes: float) -> Iterator[None]:
    """Hold `gigabytes` of the `total` that steps on this machine may take together; waits until so much is free.

    All processes of a user that declare a total take from the same memory, whichever survey or runner they belong
    to. What a killed process held is free at once: the kernel lets go of its locks. One that needs more than the
    total runs alone.
    """
    if total is None:
        yield
        return
    slots = max(1, int(total / SLOT))
    wanted = min(slots, max(1, round(gigabytes / SLOT)))
    with ExitStack() as held:
        folder = Path(tempfile.gettempdir()) / f"scan2sim-memory-{os.getuid()}"
        try:
            with ExitStack() as stack:
                place = _own_folder(folder, stack)
                queue = _opened(place, "queue", stack)  # held while waiting: nobody small overtakes
                fcntl.flock(queue, fcntl.LOCK_EX)
                while not _taken(place, slots, wanted, held):
                    time.sleep(PAUSE)
        except OSError as error:
            raise from_os_error(error, folder) from error
        yield


def _own_folder(folder: Path, stack: ExitStack) -> int:
    """A folder of this user's alone, open; others may have put something else in its predictable place.

    Raises:
        UnavailableError: they have.
    """
    with suppress(FileExistsError):
        folder.mkdir(0o700)
    try:
        place = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        stack.callback(os.close, place)
        stat = os.fstat(place)
    except OSError:
        stat = None
    if stat is None or stat.st_uid != os.getuid():
        remedy = "Have it removed, or set TMPDIR to a folder of your own, the same for all runs"
        raise UnavailableError(folder, "is a link, a file, or another user's: runs can't share memory out", remedy)
    os.fchmod(place, 0o700)
    return place


def _opened(place: int, name: str, stack: ExitStack) -> int:
    """A file in the folder, open until the stack ends."""
    file = os.open(name, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600, dir_fd=place)
    stack.callback(os.close, file)
    return file


def _taken(place: int, slots: int, wanted: int, held: ExitStack) -> bool:
    """Try to lock `wanted` slots, all or none."""
    with ExitStack() as stack:
        count = 0
        for i in range(slots):
            with ExitStack() as one:
                file = _opened(place, f"{i:05d}", one)
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    continue
                stack.enter_context(one.pop_all())
            count += 1
            if count == wanted:
                held.enter_context(stack.pop_all())
                return True
    return False
