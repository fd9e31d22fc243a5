"""Autoscaling policy: number of workers, limits, cool-down; forecasts of rates."""

from __future__ import annotations

import random

import pytest

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.services.monitoring.autoscale.forecast import DAY, MovingAverage, ScaledProfile, Trend, daily_profile
from scan2sim.services.monitoring.autoscale.policy import Scaler, workers_for
from scan2sim.services.monitoring.autoscale.traffic_model import HOUR, rate
from scan2sim.services.monitoring.settings.scaling import ScalingParams


@pytest.mark.parametrize(
    ("rate", "waiting", "workers"),
    [(0, 0, 1), (1.1, 0, 1), (1.11, 0, 2), (4.5, 0, 5), (100, 0, 5), (0.5, 8, 1), (0.5, 9, 2), (0.5, 10_000, 5)],
)
def test_workers_follow_the_rate_and_the_queue_length(rate: float, waiting: int, workers: int) -> None:
    assert workers_for(rate, waiting, ScalingParams()) == workers


def test_scaling_up_is_immediate_and_scaling_down_is_delayed() -> None:
    scaler = Scaler(ScalingParams(window=10, cool_down=60))
    counts = [scaler.decide(t, 1, 4 if 100 <= t < 200 else 1, 0) for t in range(400)]
    assert counts[90] == 1 and counts[110] == 4 and set(counts[110:250]) == {4}
    assert counts[-1] == 1 and counts == sorted(counts[:200]) + sorted(counts[200:], reverse=True)


def test_number_of_workers_stays_within_the_limits() -> None:
    drawn = random.Random(0)
    scaler = Scaler(ScalingParams(min_workers=2, max_workers=3, window=1, cool_down=0))
    seen = {scaler.decide(t, 1, drawn.choice((0, 1, 5, 1000)), drawn.choice((0, 10**6))) for t in range(300)}
    assert seen == {2, 3}


def test_contradictory_limits_are_rejected() -> None:
    with pytest.raises(SettingError, match="must not be above --max-workers"):
        Scaler(ScalingParams(min_workers=6))


def test_forecasts_of_a_rising_rate() -> None:
    average, trend = MovingAverage(60), Trend(60)
    for t in range(0, 1200, 10):
        for forecast in (average, trend):
            forecast.observe(t, 10, t)
    assert average.predict(300) == pytest.approx(116.5, abs=2)  # lags by half a window
    assert trend.predict(300) == pytest.approx((1190 + 300) / 10, abs=2)
    assert Trend(60).predict(300) == MovingAverage(60).predict(300) == 0


def test_daily_profile_is_scaled_by_todays_events() -> None:
    history = [(day * DAY + t, round(60 * rate(50, day, t / HOUR))) for day in range(7) for t in range(0, 86_400, 60)]
    usual = daily_profile(history)
    assert usual(8 * HOUR) == pytest.approx(rate(50, 0, 8), rel=0.1)
    assert usual(5 * DAY + 8 * HOUR) == pytest.approx(rate(50, 5, 8), rel=0.2)
    busy = ScaledProfile(900, usual)
    for minute in range(5 * 60, 7 * 60):
        busy.observe(minute * 60, 60, round(60 * 1.5 * rate(50, 0, minute / 60)))
    assert busy.predict(HOUR) == pytest.approx(1.5 * rate(50, 0, 8), rel=0.1)
