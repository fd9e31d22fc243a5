"""Autoscaling policy: number of workers from the predicted rate and the queue length, within limits."""

from __future__ import annotations

import math
from collections import deque
from typing import Annotated

from pydantic import Field

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.step import Params
from scan2sim.services.monitoring.autoscale.forecast import Forecast, Kind, MovingAverage, Trend

MAX_WORKERS = 1000
"""Upper bound of the setting `max_workers`."""


class ScalingParams(Params):
    """Settings of the autoscaling policy; the defaults of capacity and delay are D3.2's (section 3.2, table 3)."""

    capacity: Annotated[float, Field(ge=0.001, le=1e6, description="Events per second that one worker processes.")] = (
        2.0
    )
    utilisation: Annotated[
        float, Field(ge=0.05, le=1, description="Target utilisation: fraction of its capacity planned per worker.")
    ] = 0.55
    delay: Annotated[
        float, Field(ge=0.001, le=86_400, description="Seconds within which the waiting events are to be processed.")
    ] = 4.0
    min_workers: Annotated[int, Field(ge=0, le=MAX_WORKERS, description="Minimum number of workers.")] = 1
    max_workers: Annotated[int, Field(ge=1, le=MAX_WORKERS, description="Maximum number of workers.")] = 5
    window: Annotated[float, Field(ge=0.01, le=86_400, description="Seconds over which the rate is averaged.")] = 300.0
    cool_down: Annotated[
        float, Field(ge=0, le=86_400, description="Scale down only if fewer workers sufficed for this many seconds.")
    ] = 300.0
    forecast: Annotated[Kind, Field(description="Rate forecast: moving average, or linear trend (Holt's method).")] = (
        "average"
    )
    lead: Annotated[
        float,
        Field(ge=0, le=86_400, description="Forecast horizon in seconds: the time that a worker takes to start."),
    ] = 0.0


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
