"""Latest states of the queues that are published on the bus (`schema.QueueState`).

Bound: `MAX_QUEUES`; a new queue replaces the one that has been silent for the longest, and is rejected if none is.
"""

from __future__ import annotations

import threading
from typing import Any

from scan2sim.pipeline.core.errors import printable
from scan2sim.services.monitoring.dashboard.history import MAX_NAME_CHARS
from scan2sim.services.monitoring.events.schema import QueueState
from scan2sim.services.monitoring.messages import RejectedError

MAX_QUEUES = 128
SILENT_AFTER_S = 20.0
"""A queue without a new state for so long, in addition to its period, counts as silent."""


class Queues:
    """Latest state of each queue; thread-safe."""

    def __init__(self) -> None:
        self._queues: dict[str, tuple[float, QueueState]] = {}
        self._lock = threading.Lock()

    def add(self, state: QueueState, at: float) -> None:
        """Store the state of a queue received at a time, seconds since the epoch.

        Raises:
            RejectedError: too many queues are active.
        """
        with self._lock:
            self._queues.pop(state.queue, None)
            if len(self._queues) >= MAX_QUEUES:
                oldest = next(iter(self._queues))
                if not _is_silent(*self._queues[oldest], at):
                    raise RejectedError(f"over the limit of {MAX_QUEUES} queues: no room")
                del self._queues[oldest]
            self._queues[state.queue] = at, state

    def state(self, now: float) -> list[dict[str, Any]]:
        """JSON-serializable states of the queues, sorted by name.

        Each has `queue`, `silent`, the rates per second `arrived`, `done` and `rejected`, and as in `QueueState`
        `waiting`, `oldest_done` (seconds), `workers`.
        """
        with self._lock:
            known = sorted(self._queues.items())
        return [_display(state) | {"silent": _is_silent(at, state, now)} for _, (at, state) in known]


def _is_silent(at: float, state: QueueState, now: float) -> bool:
    return now - at > state.seconds + SILENT_AFTER_S


def _display(state: QueueState) -> dict[str, Any]:
    seconds = max(state.seconds, 1e-3)
    return {
        "queue": printable(state.queue)[:MAX_NAME_CHARS],
        **{name: getattr(state, name) / seconds for name in ("arrived", "done", "rejected")},
        **{name: getattr(state, name) for name in ("waiting", "oldest_done", "workers")},
    }
