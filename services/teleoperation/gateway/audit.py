"""Audit trail: who joined, drove, stopped or released what, when; entries are written before the action, never changed.

Each entry contains the SHA-256 of the one before (`previous`), so that a changed, removed or inserted entry is found.
The newest hash covers the whole file: noted elsewhere, it also proves that no entry was removed from the end.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from scan2sim.pipeline.core.errors import InputError, from_os_error

RECENT_ENTRIES_MAX = 500
"""Newest entries that are kept in memory."""


FIRST = "0" * 64
"""`previous` of the first entry."""


@dataclass(frozen=True)
class Verification:
    """Result of verifying an audit trail.

    Attributes:
        entries: their number; head: SHA-256 of the newest; damage: what is wrong with the chain, empty: nothing.
    """

    entries: int
    head: str
    damage: str


def verify(path: Path) -> Verification:
    """Verify the chain of an audit trail; lines truncated by a crash, and entries before the first hash, are skipped.

    Raises:
        InputError: the file can't be read.
    """
    entries, head, chained, damage = 0, FIRST, False, ""
    for number, line, entry in _entries(path):
        chained |= "previous" in entry
        if chained and entry.get("previous") != head and not damage:
            damage = f"line {number}: the entry before it was changed or removed, or this one was inserted"
        entries, head = entries + 1, _digest(line)
    return Verification(entries, head, damage)


def read(path: Path) -> list[dict[str, Any]]:
    """All entries of an audit trail, oldest first; lines truncated by a crash are skipped.

    Raises:
        InputError: the file can't be read.
    """
    return [entry for _, _, entry in _entries(path)]


def _entries(path: Path) -> Iterator[tuple[int, bytes, dict[str, Any]]]:
    """Number, text and content of each line that is an entry."""
    try:
        with path.open("rb") as file:
            for number, line in enumerate(file, 1):
                try:
                    entry = json.loads(line)
                except ValueError:
                    continue
                if isinstance(entry, dict):
                    yield number, line, entry
    except OSError as error:
        raise InputError(
            path, str(error.strerror), "Give the gateway's audit.jsonl, or the folder of --state"
        ) from None


def _digest(line: bytes) -> str:
    return hashlib.sha256(line.strip()).hexdigest()


class AuditTrail:
    """Audit trail in a file of JSON lines.

    Attributes:
        newest: the latest entries.
        verification: of the file, as it was opened; `head` is kept up to date.
    """

    def __init__(self, path: Path) -> None:
        """`path`: appended to if it exists; a line truncated by a crash is left as it is."""
        self._path = path
        self.verification = verify(path) if path.is_file() else Verification(0, FIRST, "")
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
        entry = {**entry, "previous": self.verification.head}
        line = json.dumps(entry).encode()
        try:
            with self._path.open("ab") as file:
                size_before = file.tell()
                truncated = size_before > 0 and not self._ends_with_newline(size_before)
                try:
                    file.write((b"\n" if truncated else b"") + line + b"\n")
                    file.flush()
                    os.fsync(file.fileno())
                except OSError:
                    os.truncate(self._path, size_before)
                    raise
        except OSError as error:
            raise from_os_error(error, self._path) from None
        self.newest.append(entry)
        self.verification = replace(self.verification, entries=self.verification.entries + 1, head=_digest(line))

    def _ends_with_newline(self, size: int) -> bool:
        with self._path.open("rb") as file:
            file.seek(size - 1)
            return file.read(1) == b"\n"
