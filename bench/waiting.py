"""Waiting for a condition."""

from __future__ import annotations

import time
from collections.abc import Callable

PAUSE_S = 0.05


def until(condition: Callable[[], object], seconds: float, *, what: str) -> None:
    """Poll a condition until it is true.

    Args:
        condition: called again and again.
        seconds: time limit.
        what: what is awaited, for the error message.

    Raises:
        TimeoutError: the condition was false for the whole time.
    """
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError(f"{what}: not within {seconds:g} s")
        time.sleep(PAUSE_S)
