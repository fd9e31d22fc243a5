"""Settings of the autoscaling policy, for code and command line."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from scan2sim.pipeline.core.step import Params

Kind = Literal["average", "trend"]
"""Forecasts that need no historical data."""
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
