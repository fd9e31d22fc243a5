"""Clocks that are off, told from records that are late."""

from __future__ import annotations

import random

from scan2sim.services.monitoring.dashboard.clock_skew import OFF, RECORDS, Skew

PERIOD = 1.0


def fed(skew: Skew, begin: float, delays: list[float], behind: float = 0.0, rate: float = 1.0) -> Skew:
    """Records that come `rate` times as fast as they were told, with delays, by a clock that is behind."""
    for number, delay in enumerate(delays):
        came = begin + number * PERIOD / rate
        skew.add(came, came - delay - behind, PERIOD)
    return skew


def test_a_clock_that_is_right_stays_so() -> None:
    delays = random.Random(1).choices([0.01, 0.1, 1.0, 5.0, 30.0], [8, 4, 2, 1, 1], k=1000)
    assert fed(Skew(), 0.0, delays).behind == 0.0


def test_what_waited_for_a_broker_and_comes_in_a_rush_proves_nothing() -> None:
    skew = fed(Skew(), 0.0, [0.1] * 60)
    for number in range(60):  # told while there was no broker for a minute; they come within a second
        skew.add(120 + number / 60, 60.0 + number, PERIOD)
        assert skew.behind == 0.0
    assert fed(skew, 121.0, [0.1] * 60).behind == 0.0
    first = Skew()  # a page that begins, and reads what there was
    for number in range(900):
        first.add(1000.0 + number / 1000, 100.0 + number, PERIOD)
        assert first.behind == 0.0


def test_one_that_is_ahead_is_known_at_once_and_one_that_is_behind_after_some_records() -> None:
    assert abs(fed(Skew(), 0.0, [0.1], behind=-30.0).behind + 29.9) < 1e-6
    assert fed(Skew(), 0.0, [0.1] * (RECORDS - 1), behind=30.0).behind == 0.0
    assert abs(fed(Skew(), 0.0, [0.1] * RECORDS, behind=30.0).behind - 30.1) < 1e-6


def test_a_rush_does_not_move_what_is_known() -> None:
    skew = fed(Skew(), 0.0, [0.1] * 20, behind=600.0)
    for number in range(60):
        change = skew.add(80 + number / 60, 20.0 + number - 600, PERIOD)
        assert change == 0.0 and abs(skew.behind - 600.1) < 1e-6


def test_a_clock_that_is_set_right_is_believed() -> None:
    skew = fed(Skew(), 0.0, [0.1] * 20, behind=-50.0)
    assert fed(skew, 20.0, [0.1] * RECORDS).behind == 0.0


def test_less_than_its_bound_is_left() -> None:
    assert fed(Skew(), 0.0, [0.0] * 50, behind=0.9 * OFF).behind == 0.0
