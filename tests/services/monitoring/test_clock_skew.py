"""Clock skew estimated from arrivals of records, as opposed to late records."""

from __future__ import annotations

import random

from scan2sim.services.monitoring.dashboard.clock_skew import SKEW_THRESHOLD_S, SKEW_WINDOW, ClockSkew

PERIOD = 1.0


def fed(skew: ClockSkew, begin: float, delays: list[float], behind: float = 0.0, rate: float = 1.0) -> ClockSkew:
    """Add records that arrive `rate` times as fast as they were created, with delays, by a clock that is behind."""
    for number, delay in enumerate(delays):
        arrived = begin + number * PERIOD / rate
        skew.add(arrived, arrived - delay - behind, PERIOD)
    return skew


def test_delays_are_not_mistaken_for_skew() -> None:
    delays = random.Random(1).choices([0.01, 0.1, 1.0, 5.0, 30.0], [8, 4, 2, 1, 1], k=1000)
    assert fed(ClockSkew(), 0.0, delays).behind == 0.0


def test_burst_of_buffered_records_is_not_mistaken_for_skew() -> None:
    skew = fed(ClockSkew(), 0.0, [0.1] * 60)
    for number in range(60):  # created during a broker outage of a minute; they arrive within a second
        skew.add(120 + number / 60, 60.0 + number, PERIOD)
        assert skew.behind == 0.0
    assert fed(skew, 121.0, [0.1] * 60).behind == 0.0
    first = ClockSkew()  # a dashboard that starts and reads the stored records
    for number in range(900):
        first.add(1000.0 + number / 1000, 100.0 + number, PERIOD)
        assert first.behind == 0.0


def test_clock_ahead_is_detected_at_once_and_clock_behind_after_a_window() -> None:
    assert abs(fed(ClockSkew(), 0.0, [0.1], behind=-30.0).behind + 29.9) < 1e-6
    assert fed(ClockSkew(), 0.0, [0.1] * (SKEW_WINDOW - 1), behind=30.0).behind == 0.0
    assert abs(fed(ClockSkew(), 0.0, [0.1] * SKEW_WINDOW, behind=30.0).behind - 30.1) < 1e-6


def test_burst_does_not_change_a_known_skew() -> None:
    skew = fed(ClockSkew(), 0.0, [0.1] * 20, behind=600.0)
    for number in range(60):
        change = skew.add(80 + number / 60, 20.0 + number - 600, PERIOD)
        assert change == 0.0 and abs(skew.behind - 600.1) < 1e-6


def test_corrected_clock_resets_the_skew() -> None:
    skew = fed(ClockSkew(), 0.0, [0.1] * 20, behind=-50.0)
    assert fed(skew, 20.0, [0.1] * SKEW_WINDOW).behind == 0.0


def test_skew_below_the_threshold_is_ignored() -> None:
    assert fed(ClockSkew(), 0.0, [0.0] * 50, behind=0.9 * SKEW_THRESHOLD_S).behind == 0.0
