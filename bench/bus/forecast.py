"""Forecasts compared: workers that a Monday's stream will need when one that is asked for now has started.

Days are drawn from the curve of `services.monitoring.autoscale.traffic_model`, each with more or less traffic than
others (10 %); the profile is that of four weeks before. Each forecast tells the rate of fifty cameras minute by minute.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from scan2sim.services.monitoring.autoscale.forecast import DAY, HOUR, Blend, Forecast, MovingAverage, Trend, daily
from scan2sim.services.monitoring.autoscale.policy import ScalingParams, workers_for
from scan2sim.services.monitoring.autoscale.traffic_model import rate

CAMERAS, STEP, WINDOW = 50, 60.0, 300.0
"""Cameras, seconds of a count, seconds of the averages."""
LEADS = (60.0, 300.0, 900.0)
"""Seconds that a worker takes to start: a container, a machine, one that loads a large model or waits for a place."""
WEEKS, MONDAYS, SPREAD = 4, 10, 0.1


def compare(seed: int = 0) -> dict[str, dict[str, float]]:
    """By lead time, mean error of the number of workers; prints it, and for how much of the time they are too few."""
    drawn = np.random.default_rng(seed)
    usual = daily([one for day in range(7 * WEEKS) for one in _day(drawn, day)])
    made: dict[str, Callable[[], Forecast]] = {
        "average": lambda: MovingAverage(WINDOW),
        "trend": lambda: Trend(WINDOW),
        "profile": lambda: Blend(3 * WINDOW, usual),
    }
    mondays = [_day(drawn, 7 * (WEEKS + number)) for number in range(MONDAYS)]
    found: dict[str, dict[str, float]] = {}
    for lead in LEADS:
        told = {name: [_errors(make(), monday, lead) for monday in mondays] for name, make in made.items()}
        for name, errors in told.items():
            all_ = np.concatenate(errors)
            key = f"{lead / 60:g} min"
            found.setdefault(key, {})[name] = round(float(np.abs(all_).mean()), 3)
            print(f"{name:8s} {lead / 60:3g} min ahead: wrong by {np.abs(all_).mean():.3f} workers, too few "
                  f"{100 * (all_ < 0).mean():.1f} % of the time", flush=True)  # fmt: skip
    return found


def _day(drawn: Any, day: int) -> list[tuple[float, int]]:
    """Seconds and counts, by minutes."""
    more = drawn.lognormal(0.0, SPREAD)
    times = day * DAY + np.arange(0, DAY, STEP)
    rates = [more * rate(CAMERAS, day % 7, float(time % DAY) / HOUR) * STEP for time in times]
    return list(zip(times.tolist(), drawn.poisson(rates).tolist(), strict=True))


def _errors(forecast: Forecast, day: list[tuple[float, int]], lead: float) -> Any:
    """Workers forecast, less those that the rate of the five minutes around that time needs."""
    params = ScalingParams(max_workers=100)
    counts = np.array([count for _, count in day], float)
    smooth = np.convolve(counts, np.ones(5) / (5 * STEP), mode="same")
    ahead, errors = int(lead / STEP), []
    for number, (time, count) in enumerate(day[: len(day) - ahead - 3]):
        forecast.observe(time + STEP, STEP, count)
        if number >= 60:
            needed = workers_for(float(smooth[number + ahead]), 0, params)
            errors.append(workers_for(forecast.ahead(lead), 0, params) - needed)
    return np.array(errors)
