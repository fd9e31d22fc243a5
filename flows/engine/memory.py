"""Memory budget: free memory, expected memory of a task, and reservation among all tasks on a machine."""

from __future__ import annotations

import fcntl
import os
import re
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

from scan2sim.pipeline.core import cgroups
from scan2sim.pipeline.core.errors import SettingError, UnavailableError, from_os_error
from scan2sim.pipeline.io.images.image import SUFFIXES

if TYPE_CHECKING:
    from scan2sim.flows.engine.planning import PlannedTask
    from scan2sim.pipeline.core.cache import Store

SLOT_GB = 0.25  # memory is reserved in slots of this size
MAX_MEMORY_GB = 20_000  # largest budget that is accepted
LIMIT_AND_USE = (("memory.max", "memory.current"), ("memory.limit_in_bytes", "memory.usage_in_bytes"))
"""Files of a control group with its limit and the memory in use, of versions 2 and 1."""
FREE_SHARE = 0.8  # of the free memory: estimates are rough, and other programs run
POLL_INTERVAL_S = 0.2  # seconds between attempts to reserve memory


def expected_memory(item: PlannedTask, store: Store) -> float:
    """Expected peak memory of a task in GB, from the sizes of its input files."""
    base, factor = item.task.step.memory
    # photos are read one at a time
    sizes = [_size(path) for path in item.inputs(store).values() if path.suffix.lower() not in SUFFIXES]
    return base + factor * sum(sizes) / 1e9


def _size(path: Path) -> int:
    if path.is_dir():
        return 0  # depth maps, texture pages: read one at a time
    return path.stat().st_size if path.exists() else 0


def parse_memory(text: str | None) -> float | None:
    """Memory in GB from "20GB", "800 MB" or "20" (GB); None for None.

    Raises:
        SettingError: the text has another form.
    """
    if text is None:
        return None
    match = re.fullmatch(r"\s*(\d{1,9}(?:\.\d{1,9})?)\s*(GB|G|MB|M)?\s*", text, re.IGNORECASE)
    size = float(match[1]) * (1e-3 if (match[2] or "G").upper().startswith("M") else 1) if match else 0.0
    if not 0 < size <= MAX_MEMORY_GB:
        raise SettingError("--memory", f"`{text[:40]}` is not an amount of memory", "Write for example 20GB, or 800MB")
    return size


def free_memory(
    proc: Path = Path("/proc/meminfo"), root: Path = cgroups.ROOT, membership: Path = cgroups.MEMBERSHIP
) -> float | None:
    """GB that steps may use now: most of what the machine, and the container or job that this runs in, have left.

    Of the memory that a container uses, files that were read are released when needed (`inactive_file`).

    Args:
        proc: the kernel's statistics.
        root, membership: as of `cgroups.folders`.

    Returns:
        None if it is unknown.
    """
    found = []
    with suppress(OSError):
        available = re.search(r"^MemAvailable:\s+(\d+) kB", proc.read_text(), re.MULTILINE)
        found += [int(available[1]) * 1024] if available else []
    for folder, names in product(cgroups.folders("memory", root, membership), LIMIT_AND_USE):
        with suppress(OSError, ValueError):  # "max" is no limit
            limit, used = (int((folder / name).read_text()) for name in names)
            files = re.search(r"^inactive_file (\d+)", (folder / "memory.stat").read_text(), re.MULTILINE)
            found.append(limit - used + (int(files[1]) if files else 0))
    return max(FREE_SHARE * min(found) / 1e9, SLOT_GB) if found else None


@contextmanager
def reserve_memory(
    total: float | None, gigabytes: float, *, sleep: Callable[[float], None] = time.sleep
) -> Iterator[None]:  # fmt: skip
    """Reserve `gigabytes` of the `total` memory of this machine; waits until that much is free.

    All processes of a user share one budget, across surveys and runners. Slots are file locks, which the kernel
    releases when a process dies. A task that needs more than the total runs alone.

    Args:
        total: GB that all tasks may use together; None: no limit.
        gigabytes: GB to reserve.
        sleep: pauses for some seconds between two attempts.
    """
    if total is None:
        yield
        return
    slots = max(1, int(total / SLOT_GB))
    wanted = min(slots, max(1, round(gigabytes / SLOT_GB)))
    with ExitStack() as held:
        folder = Path(tempfile.gettempdir()) / f"scan2sim-memory-{os.getuid()}"
        try:
            with ExitStack() as stack:
                place = _own_folder(folder, stack)
                queue = _open_file(place, "queue", stack)  # held while waiting, so that smaller tasks don't overtake
                fcntl.flock(queue, fcntl.LOCK_EX)
                while not _lock_slots(place, slots, wanted, held):
                    sleep(POLL_INTERVAL_S)
        except OSError as error:
            raise from_os_error(error, folder) from error
        yield


def _own_folder(folder: Path, stack: ExitStack) -> int:
    """Open a folder that only this user can access; its path is predictable, so another user may have created it.

    Raises:
        UnavailableError: the path belongs to another user, or is not a folder.
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
        remedy = "Delete it, or set TMPDIR to a folder of your own, the same for all runs"
        raise UnavailableError(
            folder, "is a link, a file, or belongs to another user: runs can't coordinate their memory", remedy
        )
    os.fchmod(place, 0o700)
    return place


def _open_file(place: int, name: str, stack: ExitStack) -> int:
    """Open a file of the folder until the stack is closed."""
    file = os.open(name, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600, dir_fd=place)
    stack.callback(os.close, file)
    return file


def _lock_slots(place: int, slots: int, wanted: int, held: ExitStack) -> bool:
    """Try to lock `wanted` free slots, all or none; whether that succeeded."""
    with ExitStack() as stack:
        count = 0
        for i in range(slots):
            with ExitStack() as one:
                file = _open_file(place, f"{i:05d}", one)
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
