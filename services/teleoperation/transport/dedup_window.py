"""Deduplication of message numbers: the first copy of each is accepted, whichever link it arrives over."""

from __future__ import annotations

WINDOW_SIZE = 4096
"""Numbers remembered, back from the highest: over a minute of messages."""
_MASK = (1 << WINDOW_SIZE) - 1


class DedupWindow:
    """Window over the message numbers of one sender, from 0."""

    def __init__(self) -> None:
        self._next = 0
        self._seen = 0  # bit k: whether number `_next` - 1 - k was received

    def add(self, number: int) -> str:
        """Add a number; returns "" for its first copy, else why it is dropped: "duplicates" or "late"."""
        ahead = number - self._next
        if ahead >= 0:
            self._seen = ((self._seen << (ahead + 1)) | 1) & _MASK if ahead < WINDOW_SIZE else 1
            self._next = number + 1
            return ""
        if -ahead > WINDOW_SIZE:
            return "late"
        bit = 1 << (-ahead - 1)
        if self._seen & bit:
            return "duplicates"
        self._seen |= bit
        return ""
