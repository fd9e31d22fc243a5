"""Alarms as events of the bus say: what is raised now, and what was cleared lately.

Bounds: `RAISED` alarms that are raised (a new one is refused beyond), the last `CLEARED` that were cleared.
"""

from __future__ import annotations

import threading
from collections import deque
from typing import Any

from scan2sim.pipeline.core.errors import printable
from scan2sim.services.monitoring.dashboard.history import NAME, Refused
from scan2sim.services.monitoring.events.schema import Alarm

RAISED, CLEARED = 256, 32


class Raised:
    """Takes alarms; may be used from any thread."""

    def __init__(self) -> None:
        self._raised: dict[tuple[str, str], dict[str, Any]] = {}
        self._cleared: deque[dict[str, Any]] = deque(maxlen=CLEARED)
        self._lock = threading.Lock()

    def take(self, alarm: Alarm, at: float) -> None:
        """Keep what an alarm says at a time, seconds since the epoch.

        Raises:
            Refused: there is no room.
        """
        place = alarm.rule, alarm.subject
        with self._lock:
            known = self._raised.pop(place, None)
            if alarm.state == "cleared":
                self._cleared.appendleft((known or _shown(alarm) | {"since": None}) | {"until": at})
            elif len(self._raised) >= RAISED:
                raise Refused(f"of more than {RAISED} alarms: no room")
            else:
                self._raised[place] = _shown(alarm) | {"since": known["since"] if known else alarm.since}

    def state(self) -> dict[str, list[dict[str, Any]]]:
        """Alarms, JSON-able, the latest first: `raised` and `cleared`.

        Each with `rule`, `subject`, `value` as it was raised last, `since` (null: before anybody listened) and, if it
        is cleared, `until`; seconds since the epoch.
        """
        with self._lock:
            latest_first = sorted(self._raised.values(), key=lambda one: -one["since"])
            return {"raised": latest_first, "cleared": list(self._cleared)}


def _shown(alarm: Alarm) -> dict[str, Any]:
    return {"rule": printable(alarm.rule)[:NAME], "subject": printable(alarm.subject)[:NAME], "value": alarm.value}
