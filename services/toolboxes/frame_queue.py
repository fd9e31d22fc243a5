"""Bounded frame queue per source with drop-oldest, served round robin."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict, deque

from scan2sim.services.toolboxes.frames import Frame

MAX_SOURCES = 256
"""Sources that can have waiting frames at the same time; frames of further sources are dropped."""


class FrameQueue:
    """Accepts frames from readers and returns them in batches; thread-safe."""

    def __init__(self, per_source: int) -> None:
        """`per_source`: maximum of waiting frames of one source."""
        self._per_source = per_source
        self._queues: OrderedDict[str, deque[Frame]] = OrderedDict()
        self._changed = threading.Condition()
        self._closed = False

    def put(self, frame: Frame) -> Frame | None:
        """Append a frame; returns the frame that is dropped for it, if any: the oldest of its source, or itself."""
        with self._changed:
            frames = self._queues.get(frame.source)
            if self._closed or (frames is None and len(self._queues) >= MAX_SOURCES):
                return frame
            if frames is None:
                frames = self._queues[frame.source] = deque()
            dropped = frames.popleft() if len(frames) >= self._per_source else None
            frames.append(frame)
            self._changed.notify_all()
            return dropped

    def put_when_free(self, frame: Frame, timeout: float) -> bool:
        """Append a frame when there is room, for readers that can wait; False if there was none within `timeout`."""
        with self._changed:
            if not self._changed.wait_for(lambda: self._closed or self._has_room(frame.source), timeout):
                return False
            return self.put(frame) is None

    def _has_room(self, source: str) -> bool:
        frames = self._queues.get(source)
        return len(self._queues) < MAX_SOURCES if frames is None else len(frames) < self._per_source

    def take(self, count: int, timeout: float, linger: float = 0.0) -> list[Frame]:
        """Take up to `count` frames, round robin over the sources, the oldest of each source first.

        Args:
            count: maximum size of the batch.
            timeout: seconds to wait for the first frame.
            linger: seconds to wait for further frames after the first.
        """
        with self._changed:
            if not self._changed.wait_for(lambda: self._closed or len(self), timeout):
                return []
            if linger and len(self) < count:
                self._changed.wait_for(lambda: self._closed or len(self) >= count, linger)
            taken = [self._next() for _ in range(min(count, len(self)))]
            self._changed.notify_all()
            return taken

    def _next(self) -> Frame:
        source, frames = self._queues.popitem(last=False)
        frame = frames.popleft()
        if frames:
            self._queues[source] = frames
        return frame

    def __len__(self) -> int:
        """Number of waiting frames."""
        return sum(map(len, self._queues.values()))

    def oldest(self) -> float:
        """Waiting time of the oldest frame in seconds; 0 without frames."""
        with self._changed:
            return max((time.monotonic() - frames[0].received for frames in self._queues.values()), default=0.0)

    def close(self) -> list[Frame]:
        """Reject further frames and return the waiting ones."""
        with self._changed:
            self._closed = True
            waiting = [frame for frames in self._queues.values() for frame in frames]
            self._queues.clear()
            self._changed.notify_all()
            return waiting
