from __future__ import annotations

import math
import random

import pytest

from scan2sim.services.teleoperation.transport.clock_sync import Clocks
from scan2sim.services.teleoperation.transport.dedup_window import SIZE, Window


class Pair:
    """Our clocks and a peer's, and a network between them."""

    def __init__(self, offset: float, wall: float = 0, drift: float = 0) -> None:
        self.now, self.offset, self.wall, self.drift = 1000.0, offset, wall, drift
        self.ours = Clocks(lambda: int(self.now * 1e9), lambda: int((self.now + 1.7e9) * 1e9))
        self.random = random.Random(3)

    def theirs(self) -> int:
        return int((self.now * (1 + self.drift) + self.offset) * 1e9)

    def exchange(self, there: float, back: float) -> None:
        asked = self.ours.monotonic()
        self.now += there
        noticed = self.theirs()
        self.now += 0.001
        answered, wall = self.theirs(), int((self.now + 1.7e9 + self.wall) * 1e9)
        self.now += back
        self.ours.exchanged(asked, noticed, answered, self.ours.monotonic(), wall)


@pytest.mark.parametrize("offset", [0.0, 12345.678, -86400.25])
def test_the_offset_is_found_within_its_uncertainty_over_a_jittery_link(offset: float) -> None:
    pair = Pair(offset)
    for _ in range(50):
        pair.exchange(0.04 + pair.random.expovariate(100), 0.04 + pair.random.expovariate(100))
        pair.now += 0.2
    assert abs(pair.ours.offset - offset) * 1e3 <= pair.ours.uncertainty_ms < 60
    assert abs(pair.ours.offset - offset) < 0.005  # what both ways share cancels
    sent = pair.theirs()
    pair.now += 0.123
    assert pair.ours.age_ms(sent) == pytest.approx(123, abs=pair.ours.uncertainty_ms)


def test_a_link_that_delays_one_way_alone_stays_within_the_uncertainty() -> None:
    pair = Pair(5.0)
    for _ in range(20):
        pair.exchange(0.2, 0.01)
    assert 0.05 < abs(pair.ours.offset - 5.0) <= pair.ours.uncertainty_ms / 1e3 < 0.12


def test_clocks_that_drift_are_followed() -> None:
    pair = Pair(0.0, drift=5e-5)
    for _ in range(3000):
        pair.exchange(0.02 + pair.random.expovariate(200), 0.02 + pair.random.expovariate(200))
        pair.now += 0.2
        true = pair.theirs() / 1e9 - pair.now
        assert abs(pair.ours.offset - true) <= pair.ours.uncertainty_ms / 1e3


def test_a_machine_that_slept_is_noticed_at_the_next_exchange() -> None:
    pair = Pair(3.0)
    for _ in range(30):
        pair.exchange(0.02, 0.02)
    pair.offset -= 60
    pair.exchange(0.02, 0.03)
    assert pair.ours.offset == pytest.approx(-57, abs=0.05)


@pytest.mark.parametrize(("wall", "wrong"), [(0, False), (0.5, False), (10, True), (-10, True), (-1.2, True)])
def test_a_wall_clock_that_is_wrong_is_told(wall: float, wrong: bool) -> None:
    pair = Pair(777.0, wall)
    assert not pair.ours.wall_wrong and math.isnan(pair.ours.wall_apart_s)
    for _ in range(20):
        pair.exchange(0.03, 0.05)
    assert pair.ours.wall_wrong is wrong
    assert pair.ours.wall_apart_s == pytest.approx(wall, abs=0.05)
    pair.wall = 0  # it was set right meanwhile
    pair.exchange(0.03, 0.05)
    assert not pair.ours.wall_wrong


def test_nothing_is_young_while_the_offset_is_unknown() -> None:
    ours = Clocks()
    assert not ours.known and ours.age_ms(ours.monotonic()) == math.inf and ours.uncertainty_ms == math.inf
    ours.exchanged(100, 90, 80, 200, 0)
    ours.exchanged(100, 0, 1000, 200, 0)
    assert not ours.known


def test_of_each_number_the_first_is_taken_whatever_the_order() -> None:
    window, chance = Window(), random.Random(1)
    numbers = [number for number in range(3000) for _ in range(2)]
    mixed = sorted(range(len(numbers)), key=lambda at: at + chance.uniform(0, 500))
    taken = [numbers[at] for at in mixed if not window.take(numbers[at])]
    assert sorted(taken) == list(range(3000))


def test_numbers_from_long_ago_are_late_and_huge_ones_cost_nothing() -> None:
    window = Window()
    assert [window.take(0), window.take(SIZE), window.take(0), window.take(1)] == ["", "", "late", ""]
    assert [window.take(2**64 - 1), window.take(5), window.take(2**64 - 1)] == ["", "late", "doubles"]
