"""Followers: a thread a source, which does what a toolbox does with that source's results, in order."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable

from scan2sim.pipeline.core.types import U8
from scan2sim.services.credentials import redacted
from scan2sim.services.toolboxes.frames import Frame
from scan2sim.services.toolboxes.results import Body
from scan2sim.services.toolboxes.tasks import Follow

log = logging.getLogger(__name__)

WAITING = 8
"""Frames of a source that wait to be followed; then the model waits."""

Outcome = Callable[[Body | str], None]
"""Is called with the result, or with why there is none."""


class Follower:
    """Of one source."""

    def __init__(self, source: str, follow: Follow) -> None:
        self._source, self._follow = redacted(source), follow
        self._line: queue.Queue[tuple[Frame, U8, Body, Outcome] | None] = queue.Queue(WAITING)
        self._last = time.monotonic()
        self._thread = threading.Thread(target=self._run, name=f"follower of {self._source}", daemon=True)
        self._thread.start()

    def put(self, frame: Frame, image: U8, body: Body, outcome: Outcome) -> None:
        """Have a frame followed, once there is room for it."""
        self._last = time.monotonic()
        self._line.put((frame, image, body, outcome))

    def idle(self) -> float:
        """Seconds since it was given a frame."""
        return time.monotonic() - self._last

    def close(self) -> None:
        """End after what waits."""
        self._line.put(None)
        self._thread.join()

    def _run(self) -> None:
        while (one := self._line.get()) is not None:
            frame, image, body, outcome = one
            followed: Body | str
            try:
                followed = self._follow(frame, image, body)
            except Exception as error:  # the next frame is another
                log.exception("%s could not be followed", self._source)
                followed = f"could not be followed ({error})"
            outcome(followed)
