"""A clock that a test sets; objects under test get it in place of the system's."""

from __future__ import annotations

import threading


class VirtualClock:
    """Virtual time: `clock()` is the time in seconds, and sleeping advances it at once; thread-safe.

    Attributes:
        seconds: the time.
    """

    def __init__(self, seconds: float = 1000.0) -> None:
        self.seconds = seconds
        self._lock = threading.Lock()

    def __call__(self) -> float:
        return self.seconds

    def ns(self) -> int:
        """The time in nanoseconds, in place of `time.monotonic_ns`."""
        return round(self.seconds * 1e9)

    def sleep(self, seconds: float) -> None:
        """Advance the time, in place of `time.sleep`."""
        with self._lock:
            self.seconds += seconds
