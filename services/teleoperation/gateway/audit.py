"""Audit trail: who joined, handed over or released what, when; entries are written before the action, never changed."""

from __future__ import annotations

import json
import os
from collections import deque
from pathlib import Path
from typing import Any

from scan2sim.pipeline.core.errors import from_os_error

RECENT_ENTRIES_MAX = 500
"""Newest entries that are kept in memory."""


class AuditTrail:
    """Audit trail in a file of JSON lines."""

    def __init__(self, path: Path) -> None:
        """`path`: appended to if it exists; a line truncated by a crash is left as it is."""
        self._path = path
        self.newest: deque[dict[str, Any]] = deque(maxlen=RECENT_ENTRIES_MAX)
        if path.is_file():
            with path.open("rb") as file:
                for line in deque(file, RECENT_ENTRIES_MAX):
                    try:
                        self.newest.append(json.loads(line))
                    except ValueError:
                        continue

    def add(self, entry: dict[str, Any]) -> None:
        """Append an entry to the file, and flush it to disk.

        Raises:
            SpaceError: it can't be written; the action that it records must not be done then.
        """
        try:
            with self._path.open("ab") as file:
                size_before = file.tell()
                truncated = size_before > 0 and not self._ends_with_newline(size_before)
                try:
                    file.write((b"\n" if truncated else b"") + json.dumps(entry).encode() + b"\n")
                    file.flush()
                    os.fsync(file.fileno())
                except OSError:
                    os.truncate(self._path, size_before)
                    raise
        except OSError as error:
            raise from_os_error(error, self._path) from None
        self.newest.append(entry)

    def _ends_with_newline(self, size: int) -> bool:
        with self._path.open("rb") as file:
            file.seek(size - 1)
            return file.read(1) == b"\n"
