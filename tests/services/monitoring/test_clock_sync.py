"""Clock offsets between machines: estimation, pings, jumps of the own clock."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import pytest

from scan2sim.services.monitoring.node import clock_sync
from scan2sim.services.monitoring.node.clock_sync import (
    EXCHANGE_WINDOW,
    INITIAL_PING_INTERVAL_S,
    MAX_UNANSWERED_PINGS,
    PING_INTERVAL_S,
    ClockSync,
)

HERE, THERE = b"h" * 16, b"t" * 16


@dataclass
class FakeTime:
    """Replaces `time`: true time in nanoseconds, and the offset of the clock of the machine that reads it."""

    now: int = 10**18
    ahead: int = 0
    stall: int = 0
    """Time for which the next reader of `time_ns` is interrupted before."""

    def time_ns(self) -> int:
        self.now, self.stall = self.now + self.stall, 0
        return self.now + self.ahead

    def monotonic(self) -> float:
        return self.now / 1e9

    def monotonic_ns(self) -> int:
        return self.now


@pytest.fixture
def times(monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeTime]:
    made = FakeTime()
    monkeypatch.setattr(clock_sync, "time", made)
    yield made


def exchange(
    times: FakeTime, here: ClockSync, there: ClockSync, ahead: int, out: int, back: int
) -> dict[str, Any] | None:
    """A ping and its reply; `ahead`: offset of the other clock, `out` and `back`: delays, all in nanoseconds."""
    for known, own in ((here, HERE), (there, THERE)):
        if hello := known.hello():
            known.handle(hello, own, times.time_ns())
    times.now += int(PING_INTERVAL_S * 1e9)
    ping = here.ping(THERE)
    if ping is None:
        return None
    times.now, times.ahead = times.now + out, ahead
    reply = there.handle(json.loads(json.dumps(ping)), HERE, times.time_ns())
    times.now, times.ahead = times.now + back, 0
    assert reply
    assert here.handle(json.loads(json.dumps(reply)), THERE, times.time_ns()) is None
    return reply


def test_offset_is_estimated_within_its_uncertainty(times: FakeTime) -> None:
    here, there, ahead = ClockSync("one"), ClockSync("two"), 250_000_000
    assert here.offset(THERE) is None
    for out, back in ((9_000_000, 1_000_000), (1_000_000, 1_200_000), (2_000_000, 30_000_000)):
        exchange(times, here, there, ahead, out, back)
    found = here.offset(THERE)
    assert found
    assert abs(found[0] - ahead) <= found[1] == 1_100_000  # of the exchange with the shortest round trip
    assert here.offset(THERE[:12] + b"2222") == found  # another publisher of that process


def test_processes_on_one_machine_are_pinged_once(times: FakeTime) -> None:
    here, there = ClockSync("one"), ClockSync("one")
    assert exchange(times, here, there, 0, 10_000, 20_000)
    assert here.offset(THERE) == (0, 0)
    assert exchange(times, here, there, 0, 10_000, 20_000) is None


def test_new_process_is_pinged_more_often_at_first(times: FakeTime) -> None:
    here, there = ClockSync("one"), ClockSync("two")
    for known, own in ((here, HERE), (there, THERE)):
        known.handle(known.hello() or {}, own, times.time_ns())
    pinged_at = []
    for _ in range(200):
        if ping := here.ping(THERE):
            pinged_at.append(times.monotonic())
            here.handle(there.handle(ping, HERE, times.time_ns()) or {}, THERE, times.time_ns())
        times.now += 10**8
    pauses = [after - before for before, after in itertools.pairwise(pinged_at)]
    expected = [INITIAL_PING_INTERVAL_S] * (EXCHANGE_WINDOW - 1) + [PING_INTERVAL_S] * 2
    assert pauses == pytest.approx(expected, abs=0.11)


def test_pings_stop_after_too_many_without_reply(times: FakeTime) -> None:
    here = ClockSync("one")
    pings = 0
    for _ in range(100):
        pings += here.ping(THERE) is not None
        times.now += int(PING_INTERVAL_S * 1e9)
    assert pings == MAX_UNANSWERED_PINGS
    assert here.offset(THERE) is None


def test_jump_of_the_own_clock_is_detected_and_discards_offsets(times: FakeTime) -> None:
    here, there = ClockSync("one"), ClockSync("two")
    exchange(times, here, there, 0, 10, 10)
    times.now += 10**9
    assert here.detect_jump() == 0
    times.ahead = -3_000_000_000
    assert here.detect_jump() == -3
    assert here.offset(THERE) is None
    assert here.detect_jump() == 0


def test_interruption_between_reading_two_clocks_is_no_jump(times: FakeTime) -> None:
    here = ClockSync("one")
    times.now, times.stall = times.now + 10**9, 3 * 10**9
    assert here.detect_jump() == 0
    times.stall, times.ahead = 3 * 10**9, 5 * 10**9
    assert here.detect_jump() == 5


@pytest.mark.parametrize("message", [{}, {"to": 1}, {"to": "x", "from": "y"}, {"host": "h"}, {"host": "h", "to": None}])
def test_malformed_messages_are_ignored(message: dict[str, Any]) -> None:
    assert ClockSync().handle(message, HERE, 0) is None
