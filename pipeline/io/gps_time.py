"""Conversion of GPS time, as stored in clouds and photos, to UTC."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

GPS_WEEK_S, DAY_S = 604_800.0, 86_400.0
ADJUSTED_OFFSET_S = 1e9  # LAS's "adjusted standard GPS time" is GPS time minus this
GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)
LEAP_SECONDS = 18.0  # GPS time minus UTC since 2017


def from_gps(seconds: float) -> datetime | None:
    """UTC of an "adjusted" GPS time (LAS: seconds since 1980 minus a billion); None where it can't be one.

    Seconds of the week are rejected, as the week is unknown. Exact since 2017; earlier dates are off by up to 18 s, as
    the leap seconds of 2017 are applied.
    """
    if 0 <= seconds <= GPS_WEEK_S or not -ADJUSTED_OFFSET_S < seconds < ADJUSTED_OFFSET_S:
        return None
    return GPS_EPOCH + timedelta(seconds=seconds + ADJUSTED_OFFSET_S - LEAP_SECONDS)


def clock_offsets(time: float, other: float) -> list[float]:
    """Seconds that convert a time of another clock to that of `time`, both of about the same moment.

    The clocks are adjusted GPS time, GPS time, seconds of the GPS week or of the day, UNIX time, and UTC variants.

    Args:
        time: seconds of the first clock.
        other: seconds of the other one.
    """
    starts = (ADJUSTED_OFFSET_S, 0.0, LEAP_SECONDS - GPS_EPOCH.timestamp())  # GPS time at which a clock is 0
    offsets = {theirs - own for own in starts for theirs in starts}
    for period in (GPS_WEEK_S, DAY_S):
        offsets |= {round((time + start - other) / period) * period - start for start in starts}
        offsets |= {start - round((other + start - time) / period) * period for start in starts}
    offsets.add(round((time - other) / DAY_S) * DAY_S)
    return sorted({one + leap for one in offsets for leap in (0.0, LEAP_SECONDS, -LEAP_SECONDS)} - {0.0}, key=abs)
