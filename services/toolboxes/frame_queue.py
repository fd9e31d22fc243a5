"""Bounded frame queues, one for each source or client, served round robin."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Sequence

from scan2sim.services.toolboxes.frames import Frame

MAX_SOURCES = 256
"""Sources and clients that can have waiting frames at the same time; frames of further ones are dropped."""

_Requests = OrderedDict[object, deque[Frame]]
"""Waiting frames of a queue by request."""


class FrameQueue:
    """Accepts frames from readers and returns them in batches; thread-safe.

    Queues are served in turn, and in each queue its requests: neither a client nor a large request delays others.
    """

    def __init__(self, per_source: int, *, clock: Callable[[], float] = time.monotonic) -> None:
        """`per_source`: maximum of waiting frames of one source; `clock`: of `Frame.received`."""
        self._per_source, self._clock = per_source, clock
        self._queues: OrderedDict[str, _Requests] = OrderedDict()
        self._changed = threading.Condition()
        self._closed = False

    def put(self, frame: Frame) -> Frame | None:
        """Append a frame; returns the frame that is dropped for it, if any: the oldest of its source, or itself."""
        with self._changed:
            if self._room(frame, self._per_source + 1) < 1:
                return frame
            dropped = None
            if self._room(frame, self._per_source) < 1:
                dropped = self._queues[frame.queue or frame.source][frame.request].popleft()
            self._append(frame)
            return dropped

    def put_when_free(self, frame: Frame, timeout: float) -> bool:
        """Append a frame when there is room, for readers that can wait; False if there was none within `timeout`."""
        with self._changed:
            if not self._changed.wait_for(lambda: self._closed or self._room(frame, self._per_source) > 0, timeout):
                return False
            return self.put(frame) is None

    def put_request(self, frames: Sequence[Frame], maximum: int) -> bool:
        """Append all frames of a request to its queue, or none (False) if more than `maximum` would wait there."""
        with self._changed:
            if self._room(frames[0], maximum) < len(frames):
                return False
            for frame in frames:
                self._append(frame)
            return True

    def _room(self, frame: Frame, maximum: int) -> int:
        """Number of frames that its queue can take."""
        waiting = self._queues.get(frame.queue or frame.source)
        if self._closed or (waiting is None and len(self._queues) >= MAX_SOURCES):
            return 0
        return maximum - sum(map(len, (waiting or {}).values()))

    def _append(self, frame: Frame) -> None:
        requests = self._queues.setdefault(frame.queue or frame.source, OrderedDict())
        requests.setdefault(frame.request, deque()).append(frame)
        self._changed.notify_all()

    def take(self, count: int, timeout: float, linger: float = 0.0) -> list[Frame]:
        """Take up to `count` frames, round robin over the queues, the oldest of each request first.

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
            taken = [self._pop(next(iter(self._queues))) for _ in range(min(count, len(self)))]
            self._changed.notify_all()
            return taken

    def _pop(self, name: str) -> Frame:
        """Take the oldest frame of the first request of a queue; request and queue move behind the others."""
        requests = self._queues.pop(name)
        request, frames = requests.popitem(last=False)
        frame = frames.popleft()
        if frames:
            requests[request] = frames
        if requests:
            self._queues[name] = requests
        return frame

    def _waiting(self) -> list[Frame]:
        return [one for requests in self._queues.values() for frames in requests.values() for one in frames]

    def __len__(self) -> int:
        """Number of waiting frames."""
        return sum(len(frames) for requests in self._queues.values() for frames in requests.values())

    def oldest(self) -> float:
        """Waiting time of the oldest frame in seconds; 0 without frames."""
        with self._changed:
            return max((self._clock() - one.received for one in self._waiting()), default=0.0)

    def close(self) -> list[Frame]:
        """Reject further frames and return the waiting ones."""
        with self._changed:
            self._closed = True
            waiting = self._waiting()
            self._queues.clear()
            self._changed.notify_all()
            return waiting
