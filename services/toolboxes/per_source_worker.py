"""Worker thread per source that post-processes the results of that source in order (tracking, for example)."""

from __future__ import annotations

import logging
import queue
import time
from collections.abc import Callable

from scan2sim.pipeline.core.types import U8
from scan2sim.services.credentials import redacted
from scan2sim.services.supervision import SupervisedThread
from scan2sim.services.toolboxes.frames import Frame
from scan2sim.services.toolboxes.results import Body
from scan2sim.services.toolboxes.tasks import PostProcessor

log = logging.getLogger(__name__)

MAX_WAITING = 8
"""Frames of a source that wait for post-processing; beyond it, the dispatcher blocks."""

Outcome = Callable[[Body | str], None]
"""Called with the result, or with an error message."""


class SourceWorker:
    """Worker thread of one source."""

    def __init__(self, source: str, post_processor: PostProcessor) -> None:
        self._source, self._post_processor = redacted(source), post_processor
        self._queue: queue.Queue[tuple[Frame, U8, Body, Outcome] | None] = queue.Queue(MAX_WAITING)
        self._last = time.monotonic()
        self._thread = SupervisedThread(self._run, f"worker of {self._source}")
        self._thread.start()

    def put(self, frame: Frame, image: U8, body: Body, outcome: Outcome) -> None:
        """Queue a frame; blocks while the queue is full."""
        self._last = time.monotonic()
        self._queue.put((frame, image, body, outcome))

    def idle(self) -> float:
        """Seconds since the last frame was queued."""
        return time.monotonic() - self._last

    def close(self) -> None:
        """Process the queued frames and stop."""
        self._queue.put(None)
        self._thread.join()

    def _run(self) -> None:
        while (one := self._queue.get()) is not None:
            frame, image, body, outcome = one
            result: Body | str
            try:
                result = self._post_processor(frame, image, body)
            except Exception as error:  # a failure must not affect the next frames
                log.exception("%s: post-processing failed", self._source)
                result = f"post-processing failed ({error})"
            outcome(result)
