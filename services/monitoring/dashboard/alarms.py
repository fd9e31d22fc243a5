"""Alarms published on the bus: those that are raised now, and those that were cleared recently.

Bounds: `MAX_RAISED` raised alarms (further ones are rejected) and the latest `MAX_CLEARED` cleared ones.
"""

from __future__ import annotations

import threading
from collections import deque
from typing import Any

from scan2sim.pipeline.core.errors import printable
from scan2sim.services.monitoring.dashboard.history import MAX_NAME_CHARS
from scan2sim.services.monitoring.events.schema import Alarm
from scan2sim.services.monitoring.messages import RejectedError

MAX_RAISED, MAX_CLEARED = 256, 32


class AlarmStates:
    """Current state of all alarms; thread-safe."""

    def __init__(self) -> None:
        self._raised: dict[tuple[str, str], dict[str, Any]] = {}
        self._cleared: deque[dict[str, Any]] = deque(maxlen=MAX_CLEARED)
        self._lock = threading.Lock()

    def add(self, alarm: Alarm, at: float) -> None:
        """Update the state by an alarm event received at a time, seconds since the epoch.

        Raises:
            RejectedError: too many alarms are raised.
        """
        key = alarm.rule, alarm.subject
        with self._lock:
            known = self._raised.pop(key, None)
            if alarm.state == "cleared":
                self._cleared.appendleft((known or _display(alarm) | {"since": None}) | {"until": at})
            elif len(self._raised) >= MAX_RAISED:
                raise RejectedError(f"over the limit of {MAX_RAISED} alarms: no room")
            else:
                by = printable(alarm.acknowledged_by)[:MAX_NAME_CHARS]
                handled = {"acknowledged_by": by, "muted_until": alarm.muted_until}
                self._raised[key] = _display(alarm) | handled | {"since": known["since"] if known else alarm.since}

    def state(self) -> dict[str, list[dict[str, Any]]]:
        """JSON-serializable lists `raised` and `cleared`, the latest first.

        Each alarm has `rule`, `subject`, `value` when it was last raised, `since` (null: raised before the history of
        the page) and, if it is cleared, `until`; a raised one who acknowledged it (`acknowledged_by`, "" nobody), and
        until when it is muted (`muted_until`, 0: not); times in seconds since the epoch.
        """
        with self._lock:
            latest_first = sorted(self._raised.values(), key=lambda one: -one["since"])
            return {"raised": latest_first, "cleared": list(self._cleared)}


def _display(alarm: Alarm) -> dict[str, Any]:
    return {
        "rule": printable(alarm.rule)[:MAX_NAME_CHARS],
        "subject": printable(alarm.subject)[:MAX_NAME_CHARS],
        "value": alarm.value,
    }
