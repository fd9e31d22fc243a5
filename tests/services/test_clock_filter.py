"""Clock offsets by four timestamps; both clock synchronizations have tests of their own."""

from __future__ import annotations

import pytest

from scan2sim.services.clock_filter import ClockFilter, Exchange
from tests.present import present


def test_offset_and_round_trip_exclude_the_processing_time() -> None:
    exchange = present(Exchange.of(100, 1_000_112, 1_000_162, 170))  # 12 out, 50 processing, 8 back
    assert exchange == Exchange(20, 1_000_002, 170)
    assert abs(exchange.offset - 1_000_000) <= exchange.uncertainty(170) == 10


@pytest.mark.parametrize("times", [(100, 90, 80, 200), (100, 0, 1000, 200), (-(10**400), 0, 0, 0)])
def test_invalid_timestamps_are_rejected(times: tuple[int, int, int, int]) -> None:
    assert Exchange.of(*times) is None


def test_recent_exchange_replaces_a_better_one_once_drift_exceeds_the_difference() -> None:
    old, new = Exchange(20, 5, 0), Exchange(40, 6, 200_000)
    for drift, best in ((0.0, old), (1e-4, new)):
        clock = ClockFilter(2, drift)
        assert clock.best is None and clock.add(old) == old and not clock.full
        assert clock.add(new) == clock.best == best and clock.full
