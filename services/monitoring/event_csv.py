"""CSV files of events: seconds from the start and size in bytes, one line each."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from pathlib import Path

from scan2sim.pipeline.core.errors import InputError
from scan2sim.services.monitoring.settings.monitor import MAX_MESSAGE_BYTES


def read_events(path: Path) -> Iterator[tuple[float, int]]:
    """Iterate over (seconds from the start, size in bytes) of a CSV file; a header line is skipped.

    Raises:
        InputError: the file can't be read, or a line is invalid or out of order.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(path, f"can't be read ({error})", "Give a CSV file with lines seconds,bytes") from None
    before = 0.0
    events = []
    for number, row in enumerate(csv.reader(text.splitlines()), 1):
        try:
            seconds, size = float(row[0]), int(row[1])
        except (ValueError, IndexError):
            if number == 1:
                continue
            raise InputError(path, f"line {number} is not 'seconds,bytes'", "Fix or delete the line") from None
        if not (math.isfinite(seconds) and seconds >= before and 0 <= size <= MAX_MESSAGE_BYTES):
            remedy = f"Seconds must not decrease, bytes must be from 0 to {MAX_MESSAGE_BYTES}"
            raise InputError(path, f"line {number} has {seconds:g} s and {size} bytes", remedy)
        before = seconds
        events.append((seconds, size))
    return iter(events)
