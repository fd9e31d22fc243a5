"""Frames that wait: a bounded line for each source, from which the oldest is dropped, served in turn."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict, deque

from scan2sim.services.toolboxes.frames import Frame

SOURCES = 256
"""Cameras that may have frames waiting at once; frames of others are dropped."""


class Waiting:
    """Takes frames from readers, hands them out in batches; may be used from any thread."""

    def __init__(self, per_source: int) -> None:
        """`per_source`: frames of one source that wait, at most."""
        self._most = per_source
        self._lines: OrderedDict[str, deque[Frame]] = OrderedDict()
        self._changed = threading.Condition()
        self._closed = False

    def put(self, frame: Frame) -> Frame | None:
        """Have a frame wait; returns the one that is dropped for it: its source's oldest, or itself."""
        with self._changed:
            line = self._lines.get(frame.source)
            if self._closed or (line is None and len(self._lines) >= SOURCES):
                return frame
            if line is None:
                line = self._lines[frame.source] = deque()
            dropped = line.popleft() if len(line) >= self._most else None
            line.append(frame)
            self._changed.notify_all()
            return dropped

    def put_when_free(self, frame: Frame, timeout: float) -> bool:
        """Have a frame wait once there is room, for a reader that can wait itself; False: there was none in time."""
        with self._changed:
            if not self._changed.wait_for(lambda: self._closed or self._has_room(frame.source), timeout):
                return False
            return self.put(frame) is None

    def _has_room(self, source: str) -> bool:
        line = self._lines.get(source)
        return len(self._lines) < SOURCES if line is None else len(line) < self._most

    def take(self, most: int, timeout: float, linger: float = 0.0) -> list[Frame]:
        """Up to `most` frames, a source at a time in turn, each source's oldest first.

        Args:
            most: frames of a batch.
            timeout: seconds to wait for the first.
            linger: seconds to wait for more once there is one.
        """
        with self._changed:
            if not self._changed.wait_for(lambda: self._closed or len(self), timeout):
                return []
            if linger and len(self) < most:
                self._changed.wait_for(lambda: self._closed or len(self) >= most, linger)
            taken = [self._next() for _ in range(min(most, len(self)))]
            self._changed.notify_all()
            return taken

    def _next(self) -> Frame:
        source, line = self._lines.popitem(last=False)
        frame = line.popleft()
        if line:
            self._lines[source] = line
        return frame

    def __len__(self) -> int:
        """Frames that wait."""
        return sum(map(len, self._lines.values()))

    def oldest(self) -> float:
        """Seconds that the longest waiting frame has waited; 0 without one."""
        with self._changed:
            return max((time.monotonic() - line[0].received for line in self._lines.values()), default=0.0)

    def close(self) -> list[Frame]:
        """Take no more; returns what waited."""
        with self._changed:
            self._closed = True
            left = [frame for line in self._lines.values() for frame in line]
            self._lines.clear()
            self._changed.notify_all()
            return left
