"""Workers are asked for as the stream needs them, never beyond the limits; forecasts know what rises."""

from __future__ import annotations

import random

import pytest

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.services.monitoring.autoscale.forecast import DAY, Blend, MovingAverage, Trend, daily
from scan2sim.services.monitoring.autoscale.policy import Scaler, ScalingParams, workers_for
from scan2sim.services.monitoring.autoscale.traffic_model import HOUR, rate


@pytest.mark.parametrize(
    ("rate", "waiting", "workers"),
    [(0, 0, 1), (1.1, 0, 1), (1.11, 0, 2), (4.5, 0, 5), (100, 0, 5), (0.5, 8, 1), (0.5, 9, 2), (0.5, 10_000, 5)],
)
def test_workers_follow_the_rate_and_what_waits(rate: float, waiting: int, workers: int) -> None:
    assert workers_for(rate, waiting, ScalingParams()) == workers


def test_more_come_at_once_and_go_after_a_while() -> None:
    scaler = Scaler(ScalingParams(window=10, cool_down=60))
    counts = [scaler.decide(t, 1, 4 if 100 <= t < 200 else 1, 0) for t in range(400)]
    assert counts[90] == 1 and counts[110] == 4 and set(counts[110:250]) == {4}
    assert counts[-1] == 1 and counts == sorted(counts[:200]) + sorted(counts[200:], reverse=True)


def test_no_stream_goes_beyond_the_limits() -> None:
    drawn = random.Random(0)
    scaler = Scaler(ScalingParams(min_workers=2, max_workers=3, window=1, cool_down=0))
    seen = {scaler.decide(t, 1, drawn.choice((0, 1, 5, 1000)), drawn.choice((0, 10**6))) for t in range(300)}
    assert seen == {2, 3}


def test_limits_that_contradict_each_other_are_refused() -> None:
    with pytest.raises(SettingError, match="must not be above --max-workers"):
        Scaler(ScalingParams(min_workers=6))


def test_forecasts_of_what_rises() -> None:
    average, trend = MovingAverage(60), Trend(60)
    for t in range(0, 1200, 10):
        for forecast in (average, trend):
            forecast.observe(t, 10, t)
    assert average.ahead(300) == pytest.approx(116.5, abs=2)  # a half window late
    assert trend.ahead(300) == pytest.approx((1190 + 300) / 10, abs=2)
    assert Trend(60).ahead(300) == MovingAverage(60).ahead(300) == 0


def test_a_profile_tells_what_comes_and_today_how_much() -> None:
    history = [(day * DAY + t, round(60 * rate(50, day, t / HOUR))) for day in range(7) for t in range(0, 86_400, 60)]
    usual = daily(history)
    assert usual(8 * HOUR) == pytest.approx(rate(50, 0, 8), rel=0.1)
    assert usual(5 * DAY + 8 * HOUR) == pytest.approx(rate(50, 5, 8), rel=0.2)
    busy = Blend(900, usual)
    for minute in range(5 * 60, 7 * 60):
        busy.observe(minute * 60, 60, round(60 * 1.5 * rate(50, 0, minute / 60)))
    assert busy.ahead(HOUR) == pytest.approx(1.5 * rate(50, 0, 8), rel=0.1)
