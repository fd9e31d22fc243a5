"""GPS time, as clouds and photos have it, as dates."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

WEEK, ADJUSTED = 604_800.0, 1e9  # seconds: of a GPS week; by which "adjusted" GPS times are less
EPOCH = datetime(1980, 1, 6, tzinfo=UTC)
LEAP = 18.0  # seconds that GPS time is ahead of UTC since 2017


def from_gps(seconds: float) -> datetime | None:
    """UTC of an "adjusted" GPS time (LAS: seconds since 1980, less a billion); None where it can't be one.

    Times that count from the beginning of a week don't tell which week. Exact since 2017; before, leap seconds that
    weren't yet there put it some seconds off.
    """
    if 0 <= seconds <= WEEK or not -ADJUSTED < seconds < ADJUSTED:
        return None
    return EPOCH + timedelta(seconds=seconds + ADJUSTED - LEAP)
