"""Waiting for a condition."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")
MIN_PAUSE_S, MAX_PAUSE_S = 0.005, 0.1
"""Shortest and, by default, longest pause between two calls of a condition."""
MAX_POLLING_SHARE = 0.1
"""Maximum share of the time spent in a condition, which may be expensive, unless the pause would be too long."""


def until(
    condition: Callable[[], T | None],
    seconds: float = 60,
    *,
    what: str = "a condition",
    state: Callable[[], object] | None = None,
    max_pause: float = MAX_PAUSE_S,
) -> T:
    """Poll a condition until it is true, and return its value.

    Args:
        condition: called again and again.
        seconds: time limit.
        what: what is awaited, for the error message.
        state: its value is added to the error message.
        max_pause: longest pause in seconds between two calls; longer for a condition that keeps another process busy.

    Raises:
        TimeoutError: the condition was false for the whole time.
    """
    end = time.monotonic() + seconds
    while True:
        began = time.monotonic()
        if value := condition():
            return value
        if time.monotonic() > end:
            raise TimeoutError(f"{what}: not within {seconds:g} s" + (f"; {state()}" if state else ""))
        time.sleep(min(max_pause, max(MIN_PAUSE_S, (time.monotonic() - began) / MAX_POLLING_SHARE)))
