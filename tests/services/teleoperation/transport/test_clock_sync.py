from __future__ import annotations

import math
import random

import pytest

from scan2sim.services.teleoperation.transport.clock_sync import ClockSync
from scan2sim.services.teleoperation.transport.dedup_window import WINDOW_SIZE, DedupWindow


class Pair:
    """Our clocks and a peer's, with a network between them."""

    def __init__(self, offset: float, wall: float = 0, drift: float = 0) -> None:
        self.now, self.offset, self.wall, self.drift = 1000.0, offset, wall, drift
        self.ours = ClockSync(lambda: int(self.now * 1e9), lambda: int((self.now + 1.7e9) * 1e9))
        self.random = random.Random(3)

    def theirs(self) -> int:
        return int((self.now * (1 + self.drift) + self.offset) * 1e9)

    def exchange(self, forward: float, back: float) -> None:
        ping_sent = self.ours.monotonic()
        self.now += forward
        ping_received = self.theirs()
        self.now += 0.001
        pong_sent, wall = self.theirs(), int((self.now + 1.7e9 + self.wall) * 1e9)
        self.now += back
        self.ours.add_exchange(ping_sent, ping_received, pong_sent, self.ours.monotonic(), wall)


@pytest.mark.parametrize("offset", [0.0, 12345.678, -86400.25])
def test_offset_is_within_its_uncertainty_over_a_jittery_link(offset: float) -> None:
    pair = Pair(offset)
    for _ in range(50):
        pair.exchange(0.04 + pair.random.expovariate(100), 0.04 + pair.random.expovariate(100))
        pair.now += 0.2
    assert abs(pair.ours.offset - offset) * 1e3 <= pair.ours.uncertainty_ms < 60
    assert abs(pair.ours.offset - offset) < 0.005  # delays common to both directions cancel
    sent = pair.theirs()
    pair.now += 0.123
    assert pair.ours.age_ms(sent) == pytest.approx(123, abs=pair.ours.uncertainty_ms)


def test_asymmetric_delay_is_within_the_uncertainty() -> None:
    pair = Pair(5.0)
    for _ in range(20):
        pair.exchange(0.2, 0.01)
    assert 0.05 < abs(pair.ours.offset - 5.0) <= pair.ours.uncertainty_ms / 1e3 < 0.12


def test_drifting_clocks_are_tracked() -> None:
    pair = Pair(0.0, drift=5e-5)
    for _ in range(3000):
        pair.exchange(0.02 + pair.random.expovariate(200), 0.02 + pair.random.expovariate(200))
        pair.now += 0.2
        true = pair.theirs() / 1e9 - pair.now
        assert abs(pair.ours.offset - true) <= pair.ours.uncertainty_ms / 1e3


def test_suspended_machine_is_detected_at_the_next_exchange() -> None:
    pair = Pair(3.0)
    for _ in range(30):
        pair.exchange(0.02, 0.02)
    pair.offset -= 60
    pair.exchange(0.02, 0.03)
    assert pair.ours.offset == pytest.approx(-57, abs=0.05)


@pytest.mark.parametrize(("wall", "wrong"), [(0, False), (0.5, False), (10, True), (-10, True), (-1.2, True)])
def test_wrong_wall_clock_is_detected(wall: float, wrong: bool) -> None:
    pair = Pair(777.0, wall)
    assert not pair.ours.wall_wrong and math.isnan(pair.ours.wall_apart_s)
    for _ in range(20):
        pair.exchange(0.03, 0.05)
    assert pair.ours.wall_wrong is wrong
    assert pair.ours.wall_apart_s == pytest.approx(wall, abs=0.05)
    pair.wall = 0  # it was corrected meanwhile
    pair.exchange(0.03, 0.05)
    assert not pair.ours.wall_wrong


def test_ages_are_infinite_while_the_offset_is_unknown() -> None:
    ours = ClockSync()
    assert not ours.known and ours.age_ms(ours.monotonic()) == math.inf and ours.uncertainty_ms == math.inf
    ours.add_exchange(100, 90, 80, 200, 0)
    ours.add_exchange(100, 0, 1000, 200, 0)
    assert not ours.known


def test_first_copy_of_each_number_is_accepted_in_any_order() -> None:
    window, chance = DedupWindow(), random.Random(1)
    numbers = [number for number in range(3000) for _ in range(2)]
    shuffled = sorted(range(len(numbers)), key=lambda at: at + chance.uniform(0, 500))
    accepted = [numbers[at] for at in shuffled if not window.add(numbers[at])]
    assert sorted(accepted) == list(range(3000))


def test_old_numbers_are_late_and_huge_ones_are_accepted() -> None:
    window = DedupWindow()
    assert [window.add(0), window.add(WINDOW_SIZE), window.add(0), window.add(1)] == ["", "", "late", ""]
    assert [window.add(2**64 - 1), window.add(5), window.add(2**64 - 1)] == ["", "late", "duplicates"]
