"""Autoscaling policy: number of workers from the predicted rate and the queue length, within limits."""

from __future__ import annotations

import math
from collections import deque

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.services.monitoring.autoscale.forecast import Forecast, MovingAverage, Trend
from scan2sim.services.monitoring.settings.scaling import Kind, ScalingParams


def workers_for(rate: float, waiting: int, params: ScalingParams) -> int:
    """Workers needed for a rate in events per second and for processing the waiting events in time, within the limits.

    Workers are planned at a target utilisation below 1: at 55 %, one event in 20 000 waits longer than 4.5 s with a
    single worker (M/D/1 queue: Poisson arrivals, constant service time), and fewer with more workers.
    """
    by_rate = rate / (params.capacity * params.utilisation)
    by_queue = waiting / (params.capacity * params.delay)
    return min(params.max_workers, max(params.min_workers, math.ceil(max(by_rate, by_queue) - 1e-9)))


class Scaler:
    """Scales up at once, but down only after a cool-down (hysteresis)."""

    def __init__(self, params: ScalingParams, forecast: Forecast | None = None) -> None:
        """`forecast` replaces the one of the parameters, for forecasts that need historical data.

        Raises:
            SettingError: the limits contradict each other.
        """
        if params.min_workers > params.max_workers:
            limits = f"{params.min_workers} and {params.max_workers}"
            raise SettingError("--min-workers", f"must not be above --max-workers (got {limits})", "Change one of them")
        self.params = params
        by_name: dict[Kind, type[MovingAverage | Trend]] = {"average": MovingAverage, "trend": Trend}
        self.forecast = forecast or by_name[params.forecast](params.window)
        self._needed: deque[tuple[float, int]] = deque()

    def decide(self, time: float, seconds: float, events: int, waiting: int) -> int:
        """Decide how many workers should run now.

        Args:
            time: end of the period, seconds.
            seconds: length of the period.
            events: number of events that arrived in the period.
            waiting: number of waiting events.
        """
        self.forecast.observe(time, seconds, events)
        needed = workers_for(self.forecast.predict(self.params.lead), waiting, self.params)
        self._needed.append((time, needed))
        while self._needed[0][0] < time - self.params.cool_down:
            self._needed.popleft()
        return max(count for _, count in self._needed)
