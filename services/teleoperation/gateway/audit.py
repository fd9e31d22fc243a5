"""The audit trail: who joined, handed over and released what, when; kept before it is done, never changed."""

from __future__ import annotations

import json
import os
from collections import deque
from pathlib import Path
from typing import Any

from scan2sim.pipeline.core.errors import from_os_error

SHOWN = 500
"""Newest entries that are kept at hand."""


class Audit:
    """A file of JSON lines."""

    def __init__(self, path: Path) -> None:
        """`path`: is continued where it is there; a line that a crash has cut short is left as it is."""
        self._path = path
        self.newest: deque[dict[str, Any]] = deque(maxlen=SHOWN)
        if path.is_file():
            with path.open("rb") as file:
                for line in deque(file, SHOWN):
                    try:
                        self.newest.append(json.loads(line))
                    except ValueError:
                        continue

    def add(self, entry: dict[str, Any]) -> None:
        """Keep it on disk.

        Raises:
            SpaceError: it can't be written; then what it is about must not be done.
        """
        try:
            with self._path.open("ab") as file:
                whole = file.tell()
                torn = whole > 0 and not self._ends_well(whole)
                try:
                    file.write((b"\n" if torn else b"") + json.dumps(entry).encode() + b"\n")
                    file.flush()
                    os.fsync(file.fileno())
                except OSError:
                    os.truncate(self._path, whole)
                    raise
        except OSError as error:
            raise from_os_error(error, self._path) from None
        self.newest.append(entry)

    def _ends_well(self, size: int) -> bool:
        with self._path.open("rb") as file:
            file.seek(size - 1)
            return file.read(1) == b"\n"
