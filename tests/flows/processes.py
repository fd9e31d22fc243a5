"""Processes found by their environment, including indirect children."""

from __future__ import annotations

from pathlib import Path


def processes(name: str, value: str) -> list[int]:
    """Ids of the processes with this environment variable."""
    found = []
    for path in Path("/proc").glob("[0-9]*/environ"):
        try:
            if f"{name}={value}" in path.read_bytes().decode(errors="replace").split("\0"):
                found.append(int(path.parent.name))
        except OSError:
            continue  # the process has ended
    return found
