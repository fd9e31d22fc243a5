"""How many workers a stream of events needs: decided from its rate and from what waits, never beyond the limits."""

from __future__ import annotations

import math
from collections import deque
from typing import Annotated

from pydantic import Field

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.step import Params
from scan2sim.services.monitoring.autoscale.forecast import Forecast, Kind, MovingAverage, Trend

MOST = 1000
"""Workers, at most."""


class ScalingParams(Params):
    """When workers are asked for; capacity and delay are D3.2's (section 3.2, table 3)."""

    capacity: Annotated[float, Field(ge=0.001, le=1e6, description="Events a second that one worker does.")] = 2.0
    utilisation: Annotated[
        float, Field(ge=0.05, le=1, description="Share of its capacity that a worker is planned for.")
    ] = 0.55
    delay: Annotated[
        float, Field(ge=0.001, le=86_400, description="Seconds within which all that waits is to be done.")
    ] = 4.0
    min_workers: Annotated[int, Field(ge=0, le=MOST, description="Workers, at least.")] = 1
    max_workers: Annotated[int, Field(ge=1, le=MOST, description="Workers, at most.")] = 5
    window: Annotated[float, Field(ge=0.01, le=86_400, description="Seconds over which the rate is averaged.")] = 300.0
    cool_down: Annotated[
        float, Field(ge=0, le=86_400, description="Seconds for which fewer must have done before one is stopped.")
    ] = 300.0
    forecast: Annotated[Kind, Field(description="How the rate is forecast: its average or its trend.")] = "average"
    lead: Annotated[
        float,
        Field(ge=0, le=86_400, description="Seconds ahead that are forecast: those that a worker takes to start."),
    ] = 0.0


def workers_for(rate: float, waiting: int, params: ScalingParams) -> int:
    """Workers for a rate, in events a second, and for all that waits to be done in time; within the limits.

    A worker is planned for part of its capacity only: at 55 % one event in 20 000 waits over 4.5 s where one worker is
    alone (M/D/1: Poisson arrivals, each served in the same time), and fewer where there are more.
    """
    by_rate = rate / (params.capacity * params.utilisation)
    by_queue = waiting / (params.capacity * params.delay)
    return min(params.max_workers, max(params.min_workers, math.ceil(max(by_rate, by_queue) - 1e-9)))


class Scaler:
    """Asks for more at once, for fewer only when fewer have done for a while."""

    def __init__(self, params: ScalingParams, forecast: Forecast | None = None) -> None:
        """`forecast` stands for the parameters' own, where it needs a history.

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
        """Workers that are to run now.

        Args:
            time: in seconds.
            seconds: that ended then.
            events: that came meanwhile.
            waiting: events that wait.
        """
        self.forecast.observe(time, seconds, events)
        needed = workers_for(self.forecast.ahead(self.params.lead), waiting, self.params)
        self._needed.append((time, needed))
        while self._needed[0][0] < time - self.params.cool_down:
            self._needed.popleft()
        return max(count for _, count in self._needed)
