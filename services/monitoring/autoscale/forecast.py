"""What a rate will be in a while, from what it was: by its moving average, by its trend, by other days at that hour."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable
from typing import Literal, Protocol

Kind = Literal["average", "trend"]
"""Forecasts that need no history."""
HOUR, DAY = 3600.0, 86_400.0
Profile = Callable[[float], float]
"""A time in seconds to the rate that is usual then."""


class Forecast(Protocol):
    """Told of counts as time goes by; says rates to come."""

    def observe(self, time: float, seconds: float, count: int) -> None:
        """So many events came in the `seconds` that ended at `time`."""

    def ahead(self, seconds: float) -> float:
        """Events a second that are to be expected so many seconds after the last observation."""


class MovingAverage:
    """It goes on as it was over a window, of so many seconds (D3.2's figure 5, the blue curve)."""

    def __init__(self, window: float) -> None:
        self._window = window
        self._seen: deque[tuple[float, int]] = deque()
        self._seconds, self._count = 0.0, 0

    def observe(self, time: float, seconds: float, count: int) -> None:
        """Of a period."""
        self._seen.append((seconds, count))
        self._seconds += seconds
        self._count += count
        while len(self._seen) > 1 and self._seconds - self._seen[0][0] >= self._window:
            oldest = self._seen.popleft()
            self._seconds -= oldest[0]
            self._count -= oldest[1]

    def ahead(self, seconds: float) -> float:
        """The mean; 0 before there is any."""
        return self._count / self._seconds if self._seconds > 0 else 0.0


class Trend:
    """It rises or falls on as it did: level and slope, each smoothed exponentially.

    Source: Holt, Forecasting seasonals and trends by exponentially weighted moving averages (1957, reprinted in
    International Journal of Forecasting 20, 2004), for periods of any length.
    """

    SLOWER = 4.0
    """The slope is smoothed over so many times the level's window: it is much the noisier."""

    def __init__(self, window: float) -> None:
        self._window = window
        self._level: float | None = None
        self._slope = 0.0

    def observe(self, time: float, seconds: float, count: int) -> None:
        """Of a period."""
        rate = count / seconds
        if self._level is None:
            self._level = rate
            return
        expected = self._level + self._slope * seconds
        level = expected + (1 - math.exp(-2 * seconds / self._window)) * (rate - expected)
        slope = (level - self._level) / seconds
        self._slope += (1 - math.exp(-2 * seconds / (self.SLOWER * self._window))) * (slope - self._slope)
        self._level = level

    def ahead(self, seconds: float) -> float:
        """The line, prolonged; never below nothing."""
        return max(0.0, (self._level or 0.0) + self._slope * seconds)


class Blend:
    """As on other days at that hour, times what today has more or less of it.

    That ratio is of the events that came within a window to those that were to be expected; as few say little, so many
    of the profile's own are added to both (the mean of a gamma prior's posterior).
    """

    PRIOR = 20.0

    def __init__(self, window: float, usual: Profile) -> None:
        self._usual, self._window = usual, window
        self._seen: deque[tuple[float, int]] = deque()
        self._expected, self._count, self._now = 0.0, 0, 0.0

    def observe(self, time: float, seconds: float, count: int) -> None:
        """Of a period."""
        self._now = time
        expected = self._usual(time - seconds / 2) * seconds
        self._seen.append((expected, count))
        self._expected += expected
        self._count += count
        while len(self._seen) > 1 and len(self._seen) * seconds > self._window:
            oldest = self._seen.popleft()
            self._expected -= oldest[0]
            self._count -= oldest[1]

    def ahead(self, seconds: float) -> float:
        """The profile's rate then, times the ratio."""
        ratio = (self._count + self.PRIOR) / (self._expected + self.PRIOR)
        return self._usual(self._now + seconds) * ratio


def daily(history: Iterable[tuple[float, int]], first_day: int = 0, width: float = 300.0) -> Profile:
    """The profile of a day, from what came on others: means over `width` seconds of the day, by straight lines.

    Args:
        history: seconds from midnight of the first day, and events; of whole days.
        first_day: of the week, 0 for Monday; days of the weekend count for themselves.
    """
    bins = round(DAY / width)
    counts = {weekend: [0.0] * bins for weekend in (False, True)}
    days: dict[bool, set[int]] = {False: set(), True: set()}
    for time, count in history:
        day = int(time // DAY)
        weekend = (day + first_day) % 7 >= 5
        counts[weekend][int(time % DAY // width) % bins] += count
        days[weekend].add(day)

    def usual(time: float) -> float:
        weekend = (int(time // DAY) + first_day) % 7 >= 5
        kind = weekend if days[weekend] else not weekend
        at = time % DAY / width - 0.5
        before, part = math.floor(at), at - math.floor(at)
        means = [counts[kind][(before + step) % bins] / (width * max(1, len(days[kind]))) for step in (0, 1)]
        return means[0] * (1 - part) + means[1] * part

    return usual
