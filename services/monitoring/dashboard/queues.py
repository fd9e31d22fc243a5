"""Queues as events of the bus say (`events.QueueState`): how each fared over its last period.

Bounds: `QUEUES` queues; a new one takes the place of that which is silent the longest, and is refused where none is.
"""

from __future__ import annotations

import threading
from typing import Any

from scan2sim.pipeline.core.errors import printable
from scan2sim.services.monitoring.dashboard.history import NAME, Refused
from scan2sim.services.monitoring.events.schema import QueueState

QUEUES = 128
SILENT = 20.0
"""Seconds beyond its period without a word after which a queue counts as silent."""


class Queues:
    """Takes states of queues; may be used from any thread."""

    def __init__(self) -> None:
        self._queues: dict[str, tuple[float, QueueState]] = {}
        self._lock = threading.Lock()

    def take(self, said: QueueState, at: float) -> None:
        """Keep what a queue says at a time, seconds since the epoch.

        Raises:
            Refused: there is no room.
        """
        with self._lock:
            self._queues.pop(said.queue, None)
            if len(self._queues) >= QUEUES:
                longest = next(iter(self._queues))
                if not _is_silent(*self._queues[longest], at):
                    raise Refused(f"of more than {QUEUES} queues: no room")
                del self._queues[longest]
            self._queues[said.queue] = at, said

    def state(self, now: float) -> list[dict[str, Any]]:
        """Queues by name, JSON-able.

        Each with `queue`, `silent`, per second `arrived`, `done` and `refused`, and what `QueueState` has of now:
        `waiting`, `oldest_done` (seconds), `workers`.
        """
        with self._lock:
            known = sorted(self._queues.items())
        return [_shown(said) | {"silent": _is_silent(at, said, now)} for _, (at, said) in known]


def _is_silent(at: float, said: QueueState, now: float) -> bool:
    return now - at > said.seconds + SILENT


def _shown(said: QueueState) -> dict[str, Any]:
    seconds = max(said.seconds, 1e-3)
    return {
        "queue": printable(said.queue)[:NAME],
        **{name: getattr(said, name) / seconds for name in ("arrived", "done", "refused")},
        **{name: getattr(said, name) for name in ("waiting", "oldest_done", "workers")},
    }
