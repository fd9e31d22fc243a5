"""Traffic as cameras see it: how many vehicles pass over a week, and events drawn from that (D3.2, section 3.2).

D3.2 drew its events from forty days of captured ones, which aren't public. Here a weekday has two rush hours, near 8 h
and near 18 h, and little at night: the shape of a road of two directions in FHWA's Freeway Management and Operations
Handbook (figure 1-3). `PEAK` is calibrated so that 10, 20 and 50 cameras ask for 1, 2 and 5 workers, as in D3.2's
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

PEAK = 0.088
"""Events a second of one camera at the top of the rush: 317 vehicles an hour, a busy lane of a town."""
SIZES = (50_000, 500_000)
"""Bytes of an event: a vehicle's picture and what is known of it (D3.2, section 3)."""
HOUR, DAY = 3600.0, 86_400.0
SATURDAY = 5


class TrafficParams(Params):
    """Events of cameras over some hours of a day; the defaults are those of D3.2's figure 5."""

    out: Annotated[Path, Field(description="CSV to write: seconds from the start, bytes; for `dataset-talker`.")]
    cameras: Annotated[int, Field(ge=1, le=10_000, description="Cameras.")] = 50
    from_hour: Annotated[float, Field(ge=0, le=24, description="Hour of the day at which it begins.")] = 6.0
    to_hour: Annotated[float, Field(ge=0, le=24, description="Hour of the day at which it ends.")] = 10.0
    day: Annotated[int, Field(ge=0, le=6, description="Day of the week, 0 for Monday.")] = 0
    seed: Annotated[Seed, Field(description="Of the random numbers: the same seed gives the same events.")] = 0


def share(day: int, hour: float) -> float:
    """Traffic at an hour of a day of the week (0: Monday), as a share of the weekdays' peak."""
    if day >= SATURDAY:
        return 0.04 + 0.5 * _hump(hour, 14.0, 3.5)
    between = 1 / (1 + math.exp(-(hour - 6.5) / 0.4)) - 1 / (1 + math.exp(-(hour - 20.0) / 0.8))
    rush = _hump(hour, 8.0, 0.8) + 0.9 * _hump(hour, 17.5, 1.2)
    return min(1.0, 0.04 + 0.5 * between + 0.47 * rush)


def _hump(hour: float, middle: float, width: float) -> float:
    return math.exp(-0.5 * ((hour - middle) / width) ** 2)


def rate(cameras: int, day: int, hour: float) -> float:
    """Events a second of so many cameras."""
    return cameras * PEAK * share(day, hour)


def events(params: TrafficParams) -> Iterator[tuple[float, int]]:
    """Seconds from the start and bytes, in order: a Poisson process of the curve's rate, sizes evenly spread.

    Raises:
        SettingError: it would end before it begins.
    """
    if params.to_hour <= params.from_hour:
        remedy = "Choose hours of one day, as --from 6 --to 10"
        raise SettingError("--to", f"must be after --from (got {params.to_hour:g} and {params.from_hour:g})", remedy)
    drawn = random.Random(params.seed)
    highest = params.cameras * PEAK
    seconds, end = 0.0, (params.to_hour - params.from_hour) * HOUR
    while (seconds := seconds + drawn.expovariate(highest)) < end:
        if drawn.random() * highest < rate(params.cameras, params.day, params.from_hour + seconds / HOUR):  # thinning
            yield round(seconds, 3), drawn.randint(*SIZES)


def write(params: TrafficParams) -> int:
    """Write them as CSV, and say how many there are."""
    rows = list(events(params))
    params.out.parent.mkdir(parents=True, exist_ok=True)
    with params.out.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(("seconds", "bytes"))
        table.writerows(rows)
    return len(rows)
