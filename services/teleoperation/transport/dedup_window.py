"""Which numbers have come: the first of each is taken, whatever link brings it."""

from __future__ import annotations

SIZE = 4096
"""Numbers that are remembered, from the highest back: over a minute of messages."""
_ALL = (1 << SIZE) - 1


class Window:
    """Of one sender's numbers, from 0."""

    def __init__(self) -> None:
        self._next = 0
        self._seen = 0  # bit k: the number k + 1 before the next

    def take(self, number: int) -> str:
        """Note a number; empty: it is the first of its kind, else what it is."""
        ahead = number - self._next
        if ahead >= 0:
            self._seen = ((self._seen << (ahead + 1)) | 1) & _ALL if ahead < SIZE else 1
            self._next = number + 1
            return ""
        if -ahead > SIZE:
            return "late"
        bit = 1 << (-ahead - 1)
        if self._seen & bit:
            return "doubles"
        self._seen |= bit
        return ""
