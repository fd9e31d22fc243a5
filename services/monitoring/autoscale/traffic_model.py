"""Traffic model: rate of vehicles passing a camera over a week, and random events sampled from it (D3.2, section 3.2).

D3.2 sampled its events from forty days of captured data, which aren't public. Here a weekday has two rush hours, near
8 h and near 18 h, and little traffic at night: the shape of a two-way road in FHWA's Freeway Management and Operations
Handbook (figure 1-3). The peak rate is calibrated so that 10, 20 and 50 cameras need 1, 2 and 5 workers, as in D3.2's
figure 5.
"""

from __future__ import annotations

import csv
import math
import random
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

from pydantic import Field

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.parameters import Seed
from scan2sim.pipeline.core.step import Params

PEAK_RATE_PER_CAMERA = 0.088
"""Events per second of one camera at the peak of the rush hour: 317 vehicles per hour, a busy urban lane."""
EVENT_BYTES = (50_000, 500_000)
"""Smallest and largest size of an event: a vehicle's image and metadata (D3.2, section 3)."""
HOUR, DAY = 3600.0, 86_400.0
SATURDAY = 5


class TrafficParams(Params):
    """Settings of simulated camera events over some hours of a day; the defaults are those of D3.2's figure 5."""

    out: Annotated[Path, Field(description="CSV file to write, for `dataset-talker`: seconds from the start, bytes.")]
    cameras: Annotated[int, Field(ge=1, le=10_000, description="Number of cameras.")] = 50
    from_hour: Annotated[float, Field(ge=0, le=24, description="Start of the simulated time, hour of the day.")] = 6.0
    to_hour: Annotated[float, Field(ge=0, le=24, description="End of the simulated time, hour of the day.")] = 10.0
    day: Annotated[int, Field(ge=0, le=6, description="Day of the week, 0 for Monday.")] = 0
    seed: Annotated[Seed, Field(description="Random seed: the same seed gives the same events.")] = 0


def traffic_share(day: int, hour: float) -> float:
    """Traffic at an hour of a day of the week (0: Monday), as a fraction of the weekday peak."""
    if day >= SATURDAY:
        return 0.04 + 0.5 * _bell_curve(hour, 14.0, 3.5)
    daytime = 1 / (1 + math.exp(-(hour - 6.5) / 0.4)) - 1 / (1 + math.exp(-(hour - 20.0) / 0.8))
    rush = _bell_curve(hour, 8.0, 0.8) + 0.9 * _bell_curve(hour, 17.5, 1.2)
    return min(1.0, 0.04 + 0.5 * daytime + 0.47 * rush)


def _bell_curve(hour: float, middle: float, width: float) -> float:
    return math.exp(-0.5 * ((hour - middle) / width) ** 2)


def rate(cameras: int, day: int, hour: float) -> float:
    """Total events per second of a number of cameras."""
    return cameras * PEAK_RATE_PER_CAMERA * traffic_share(day, hour)


def events(params: TrafficParams) -> Iterator[tuple[float, int]]:
    """Iterate over (seconds from the start, bytes) of an inhomogeneous Poisson process with uniform event sizes.

    Raises:
        SettingError: the end isn't after the start.
    """
    if params.to_hour <= params.from_hour:
        remedy = "Choose hours of one day, such as --from 6 --to 10"
        raise SettingError("--to", f"must be after --from (got {params.to_hour:g} and {params.from_hour:g})", remedy)
    generator = random.Random(params.seed)
    peak_rate = params.cameras * PEAK_RATE_PER_CAMERA
    seconds, end = 0.0, (params.to_hour - params.from_hour) * HOUR
    while (seconds := seconds + generator.expovariate(peak_rate)) < end:
        current_rate = rate(params.cameras, params.day, params.from_hour + seconds / HOUR)
        if generator.random() * peak_rate < current_rate:  # thinning
            yield round(seconds, 3), generator.randint(*EVENT_BYTES)


def write(params: TrafficParams) -> int:
    """Write the events as CSV and return their number."""
    rows = list(events(params))
    params.out.parent.mkdir(parents=True, exist_ok=True)
    with params.out.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(("seconds", "bytes"))
        table.writerows(rows)
    return len(rows)
