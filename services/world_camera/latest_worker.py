"""Worker thread that processes the latest item: items that wait while it is busy are replaced by newer ones."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Generic, TypeVar

from scan2sim.services.supervision import SupervisedThread

T = TypeVar("T")
log = logging.getLogger(__name__)


class LatestWorker(Generic[T]):
    """Runs a job for the latest item.

    Attributes:
        replaced: number of items that were replaced before the job ran for them.
    """

    def __init__(self, job: Callable[[T], None], name: str) -> None:
        self._job, self._name = job, name
        self._item: T | None = None
        self._changed, self._ended, self.replaced = threading.Condition(), False, 0
        self._thread = SupervisedThread(self._run, name)
        self._thread.start()

    def put(self, item: T) -> None:
        """Pass an item to the job, which runs for it when it is free."""
        with self._changed:
            self.replaced += self._item is not None
            self._item = item
            self._changed.notify_all()

    def close(self) -> None:
        """Finish the current item, and end the thread."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        self._thread.join()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._ended or self._item is not None)
                item, self._item = self._item, None
            if self._ended or item is None:
                return
            try:
                self._job(item)
            except Exception:  # the next item may be fine
                log.exception("%s: an image failed", self._name)
