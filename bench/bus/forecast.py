"""Compare forecasts: workers needed by a Monday's stream at the time when a worker requested now has started.

Days are drawn from the curve of `services.monitoring.autoscale.traffic_model`, with a random daily volume (10 %); the
profile is learned from the four weeks before. Each forecast predicts the rate of fifty cameras every minute.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from scan2sim.services.monitoring.autoscale.forecast import (
    DAY,
    HOUR,
    Forecast,
    MovingAverage,
    ScaledProfile,
    Trend,
    daily_profile,
)
from scan2sim.services.monitoring.autoscale.policy import workers_for
from scan2sim.services.monitoring.autoscale.traffic_model import rate
from scan2sim.services.monitoring.settings.scaling import ScalingParams

CAMERAS, STEP_S, WINDOW_S = 50, 60.0, 300.0
"""Number of cameras, seconds of a count, seconds of the averages."""
LEADS_S = (60.0, 300.0, 900.0)
"""Start-up times of a worker: a container, a machine, one that loads a large model or waits in a queue."""
WEEKS, MONDAYS, DAILY_SPREAD = 4, 10, 0.1


def compare(seed: int = 0) -> dict[str, dict[str, float]]:
    """Mean error of the number of workers by lead time; also prints how often they are too few."""
    rng = np.random.default_rng(seed)
    profile = daily_profile([one for day in range(7 * WEEKS) for one in _day(rng, day)])
    made: dict[str, Callable[[], Forecast]] = {
        "average": lambda: MovingAverage(WINDOW_S),
        "trend": lambda: Trend(WINDOW_S),
        "profile": lambda: ScaledProfile(3 * WINDOW_S, profile),
    }
    mondays = [_day(rng, 7 * (WEEKS + number)) for number in range(MONDAYS)]
    found: dict[str, dict[str, float]] = {}
    for lead in LEADS_S:
        by_name = {name: [_errors(make(), monday, lead) for monday in mondays] for name, make in made.items()}
        for name, errors in by_name.items():
            all_ = np.concatenate(errors)
            key = f"{lead / 60:g} min"
            found.setdefault(key, {})[name] = round(float(np.abs(all_).mean()), 3)
            print(f"{name:8s} {lead / 60:3g} min ahead: mean error {np.abs(all_).mean():.3f} workers, too few "
                  f"{100 * (all_ < 0).mean():.1f} % of the time", flush=True)  # fmt: skip
    return found


def _day(rng: Any, day: int) -> list[tuple[float, int]]:
    """Times in seconds and counts of each minute."""
    volume = rng.lognormal(0.0, DAILY_SPREAD)
    times = day * DAY + np.arange(0, DAY, STEP_S)
    rates = [volume * rate(CAMERAS, day % 7, float(time % DAY) / HOUR) * STEP_S for time in times]
    return list(zip(times.tolist(), rng.poisson(rates).tolist(), strict=True))


def _errors(forecast: Forecast, day: list[tuple[float, int]], lead: float) -> Any:
    """Predicted workers minus those needed for the mean rate of the five minutes around the predicted time."""
    params = ScalingParams(max_workers=100)
    counts = np.array([count for _, count in day], float)
    smooth = np.convolve(counts, np.ones(5) / (5 * STEP_S), mode="same")
    ahead, errors = int(lead / STEP_S), []
    for number, (time, count) in enumerate(day[: len(day) - ahead - 3]):
        forecast.observe(time + STEP_S, STEP_S, count)
        if number >= 60:
            needed = workers_for(float(smooth[number + ahead]), 0, params)
            errors.append(workers_for(forecast.predict(lead), 0, params) - needed)
    return np.array(errors)
