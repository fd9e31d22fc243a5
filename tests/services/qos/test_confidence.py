"""Confidence bounds contain the true share as often as they should, and runs are as long as their limits need."""

from __future__ import annotations

import math

import numpy as np
import pytest

from scan2sim.services.qos.confidence import CONFIDENCE, share_bounds, trials_needed
from scan2sim.services.qos.measure import MAX_SECONDS, MIN_SECONDS, MeasureParams, duration
from scan2sim.services.qos.requirements import Environment, read


def test_no_event_in_n_trials_shows_three_in_n() -> None:
    low, high = share_bounds(0, 30_000)
    assert low == 0 and high == pytest.approx(3 / 30_000, rel=0.01)
    assert share_bounds(5, 5)[1] == 1


@pytest.mark.parametrize("share", [0.0005, 0.01, 0.3])
def test_bounds_hold_with_the_stated_probability(share: float) -> None:
    found = np.random.default_rng(1).binomial(2000, share, 3000)
    bounds = {int(events): share_bounds(int(events), 2000) for events in set(found.tolist())}
    assert np.mean([bounds[int(events)][0] <= share for events in found]) > CONFIDENCE - 0.01
    assert np.mean([bounds[int(events)][1] >= share for events in found]) > CONFIDENCE - 0.01


@pytest.mark.parametrize(("limit", "expected"), [(1e-3, 2e-4), (1e-4, 5e-5), (1e-5, 2e-4), (1e-4, 0.0)])
def test_the_needed_trials_usually_decide(limit: float, expected: float) -> None:
    trials = int(trials_needed(limit, expected))
    found = np.random.default_rng(2).binomial(trials, expected, 500)
    decided = [(share_bounds(int(events), trials), events) for events in found]
    assert np.mean([low > limit if expected > limit else high <= limit for (low, high), _ in decided]) > 0.8


def test_a_share_at_its_limit_is_never_decided() -> None:
    assert trials_needed(0.0, 0.0) == trials_needed(1e-3, 1e-3) == math.inf


def test_runs_are_as_long_as_the_limits_need_unless_a_duration_is_given() -> None:
    found = {}
    for service in ("classify", "detect", "movement"):
        params = MeasureParams(service=service, environment=Environment.EDGE)
        found[service] = duration(params, read(service).of(params.environment))[0]
    assert found["classify"] == MIN_SECONDS < found["detect"] < found["movement"] <= MAX_SECONDS
    given = MeasureParams(service="movement", seconds=5)
    assert duration(given, read("movement").of(given.environment))[0] == 5
