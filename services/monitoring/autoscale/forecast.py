"""Forecasts of an event rate: moving average, exponentially smoothed trend, and daily profile."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable
from typing import Protocol

HOUR, DAY = 3600.0, 86_400.0
Profile = Callable[[float], float]
"""Function from a time in seconds to the usual rate at that time, events per second."""


class Forecast(Protocol):
    """Predicts the rate of events from past counts."""

    def observe(self, time: float, seconds: float, count: int) -> None:
        """Add an observation: `count` events arrived in the `seconds` that ended at `time`."""

    def predict(self, seconds: float) -> float:
        """Predicted events per second, `seconds` after the last observation."""


class MovingAverage:
    """Mean rate over a window of seconds (D3.2's figure 5, the blue curve)."""

    def __init__(self, window: float) -> None:
        self._window = window
        self._seen: deque[tuple[float, int]] = deque()
        self._seconds, self._count = 0.0, 0

    def observe(self, time: float, seconds: float, count: int) -> None:
        """Add an observation."""
        self._seen.append((seconds, count))
        self._seconds += seconds
        self._count += count
        while len(self._seen) > 1 and self._seconds - self._seen[0][0] >= self._window:
            oldest = self._seen.popleft()
            self._seconds -= oldest[0]
            self._count -= oldest[1]

    def predict(self, seconds: float) -> float:
        """The mean; 0 before the first observation."""
        return self._count / self._seconds if self._seconds > 0 else 0.0


class Trend:
    """Linear extrapolation by double exponential smoothing of level and slope.

    Source: Holt, Forecasting seasonals and trends by exponentially weighted moving averages (1957, reprinted in
    International Journal of Forecasting 20, 2004), for periods of any length.
    """

    SLOPE_WINDOW_FACTOR = 4.0
    """The slope is smoothed over this multiple of the level's window, because it is much noisier."""

    def __init__(self, window: float) -> None:
        self._window = window
        self._level: float | None = None
        self._slope = 0.0

    def observe(self, time: float, seconds: float, count: int) -> None:
        """Add an observation."""
        rate = count / seconds
        if self._level is None:
            self._level = rate
            return
        expected = self._level + self._slope * seconds
        level = expected + (1 - math.exp(-2 * seconds / self._window)) * (rate - expected)
        slope = (level - self._level) / seconds
        slope_window = self.SLOPE_WINDOW_FACTOR * self._window
        self._slope += (1 - math.exp(-2 * seconds / slope_window)) * (slope - self._slope)
        self._level = level

    def predict(self, seconds: float) -> float:
        """Level and slope extrapolated linearly, at least 0."""
        return max(0.0, (self._level or 0.0) + self._slope * seconds)


class ScaledProfile:
    """Daily profile times the ratio of today's events to the profile.

    The ratio compares observed and expected events within a window. `PRIOR_EVENTS` are added to both, so that a few
    events have little influence (posterior mean with a gamma prior).
    """

    PRIOR_EVENTS = 20.0

    def __init__(self, window: float, usual: Profile) -> None:
        self._usual, self._window = usual, window
        self._seen: deque[tuple[float, int]] = deque()
        self._expected, self._count, self._now = 0.0, 0, 0.0

    def observe(self, time: float, seconds: float, count: int) -> None:
        """Add an observation."""
        self._now = time
        expected = self._usual(time - seconds / 2) * seconds
        self._seen.append((expected, count))
        self._expected += expected
        self._count += count
        while len(self._seen) > 1 and len(self._seen) * seconds > self._window:
            oldest = self._seen.popleft()
            self._expected -= oldest[0]
            self._count -= oldest[1]

    def predict(self, seconds: float) -> float:
        """Rate of the profile at that time, times the ratio."""
        ratio = (self._count + self.PRIOR_EVENTS) / (self._expected + self.PRIOR_EVENTS)
        return self._usual(self._now + seconds) * ratio


def daily_profile(history: Iterable[tuple[float, int]], first_day: int = 0, width: float = 300.0) -> Profile:
    """Mean daily profile of past events, in bins of `width` seconds with linear interpolation.

    Args:
        history: (seconds from midnight of the first day, number of events), covering whole days.
        first_day: day of the week, 0 for Monday; weekends have a separate profile.
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
