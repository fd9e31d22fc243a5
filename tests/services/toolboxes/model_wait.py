"""Waiting for the model of an engine under the control of a test: `wait` of `engine.Engine`."""

from __future__ import annotations

import threading
from multiprocessing.connection import Connection
from pathlib import Path

from scan2sim.services.toolboxes.worker import LOAD_TIMEOUT_S
from tests.fakes.virtual_clock import VirtualClock

POLL_S = 0.02


class ModelWait:
    """Waits for a model's responses in virtual time: only a model that hangs (`shaky.HANGS`) exceeds its limit.

    Attributes:
        took: virtual durations of the next batches, seconds; of further ones: 0.
        limits: exceeded limits, seconds.
    """

    def __init__(self, clock: VirtualClock | None = None, hangs: Path = Path("/nonexistent")) -> None:
        """`hangs`: file that a model creates when it begins to hang."""
        self.took, self.limits = list[float](), list[float]()
        self._clock, self._hangs = clock or VirtualClock(), hangs
        self._held, self._passes, self._changed = False, 0, threading.Condition()

    def hold(self) -> None:
        """Hold back all responses, also those of a model that has loaded."""
        self._held = True

    def let_pass(self, count: int) -> None:
        """Let some of the responses pass that are held back."""
        with self._changed:
            self._passes += count
            self._changed.notify_all()

    def release(self) -> None:
        """Hold back no more responses."""
        with self._changed:
            self._held, self._passes = False, 0
            self._changed.notify_all()

    def __call__(self, connection: Connection, seconds: float) -> bool:
        with self._changed:
            self._changed.wait_for(lambda: not self._held or self._passes)
            self._passes = max(self._passes - 1, 0)
        while not connection.poll(POLL_S):
            if self._hangs.exists():
                self._hangs.unlink()
                self.limits.append(seconds)
                self._clock.sleep(seconds)
                return False
        if seconds < LOAD_TIMEOUT_S and self.took:
            self._clock.sleep(self.took.pop(0))
        return True
