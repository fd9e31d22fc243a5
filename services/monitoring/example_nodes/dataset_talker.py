"""Sends messages when, and as large as, a file says: a line of CSV each, seconds from the start and bytes."""

from __future__ import annotations

import csv
import json
import math
import time
from collections.abc import Iterator
from pathlib import Path

from scan2sim.pipeline.core.errors import InputError
from scan2sim.services.monitoring.node.monitor import STRING, Monitor, ros
from scan2sim.services.monitoring.settings.monitor import LARGEST, DatasetParams

LATE = 0.001
"""Seconds before its time from which on a message is due."""


class DatasetTalker(Monitor):
    """Replays a file."""

    def __init__(self, params: DatasetParams) -> None:
        self._events = read_events(params.data)
        super().__init__(params.name, **params.monitored())
        self._speed, self._field = params.speed, params.size_as_field
        self._publisher = self.create_publisher(ros.message_type(STRING), params.topic, 100)
        self._subscribers = params.subscribers
        self._began: float | None = None
        self._next = next(self._events, None)
        self.create_timer(0.005, self._send_due)

    @property
    def finished(self) -> bool:
        """Whether all is sent."""
        return self._next is None

    def _send_due(self) -> None:
        if self._began is None:
            if self._publisher.get_subscription_count() < self._subscribers:
                return
            self._began = time.monotonic()
        now = (time.monotonic() - self._began) * self._speed
        while self._next is not None and self._next[0] <= now + LATE:
            seconds, size = self._next
            data = json.dumps({"time": seconds, "size": size}) if self._field else "x" * size
            self._publisher.publish(ros.message(STRING, data=data))
            self._next = next(self._events, None)


def read_events(path: Path) -> Iterator[tuple[float, int]]:
    """Seconds from the start and bytes, in order of time; a header line is skipped.

    Raises:
        InputError: a line that isn't so.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(path, f"can't be read ({error})", "Give a CSV file: seconds, bytes") from None
    before = 0.0
    events = []
    for number, row in enumerate(csv.reader(text.splitlines()), 1):
        try:
            seconds, size = float(row[0]), int(row[1])
        except (ValueError, IndexError):
            if number == 1:
                continue
            raise InputError(path, f"line {number} is not 'seconds,bytes'", "Mend or delete it") from None
        if not (math.isfinite(seconds) and seconds >= before and 0 <= size <= LARGEST):
            remedy = f"Seconds must not go back, bytes are from 0 to {LARGEST}"
            raise InputError(path, f"line {number} holds {seconds:g} s and {size} bytes", remedy)
        before = seconds
        events.append((seconds, size))
    return iter(events)
