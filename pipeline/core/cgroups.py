"""Control groups of this process: limits that a container, a job of a cluster or systemd sets."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

ROOT = Path("/sys/fs/cgroup")
MEMBERSHIP = Path("/proc/self/cgroup")


def folders(controller: str, root: Path = ROOT, membership: Path = MEMBERSHIP) -> Iterator[Path]:
    """Folders of the control groups that limit this process, from its own to the root; some may not exist.

    Args:
        controller: "memory" or "cpu".
        root: where control groups are mounted; version 1 has a folder for each controller below it.
        membership: the kernel's list of this process's groups, "ID:CONTROLLERS:PATH"; version 2 names no controllers.
    """
    text = ""
    with suppress(OSError):
        text = membership.read_text(encoding="utf-8", errors="replace")
    for line in text.splitlines() or ["0::/"]:
        _, controllers, path = line.split(":", 2)
        if controllers and controller not in controllers.split(","):
            continue
        # in a container, the path may be that of the machine, which doesn't exist there
        parts = [part for part in path.split("/") if part not in ("", "..")]
        for count in range(len(parts), -1, -1):
            yield root.joinpath(*([controller] if controllers else []), *parts[:count])
