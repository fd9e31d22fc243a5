"""Clocks that differ are found, and latencies are right in spite of them."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import pytest

from scan2sim.services.monitoring.node import clock_sync
from scan2sim.services.monitoring.node.clock_sync import KEPT, PING_AT_FIRST, PING_EVERY, TRIES, Clock

HERE, THERE = b"h" * 16, b"t" * 16


@dataclass
class Times:
    """A time that all machines share, and by how much one's clock is ahead of it (nanoseconds)."""

    now: int = 10**18
    ahead: int = 0

    def time_ns(self) -> int:
        return self.now + self.ahead

    def monotonic(self) -> float:
        return self.now / 1e9

    def monotonic_ns(self) -> int:
        return self.now


@pytest.fixture
def times(monkeypatch: pytest.MonkeyPatch) -> Iterator[Times]:
    made = Times()
    monkeypatch.setattr(clock_sync, "time", made)
    yield made


def exchange(times: Times, here: Clock, there: Clock, ahead: int, out: int, back: int) -> dict[str, Any] | None:
    """A ping and its answer; the other's clock is ahead by so much, the ways take so long."""
    for known, own in ((here, HERE), (there, THERE)):
        if hello := known.hello():
            known.heard(hello, own, times.time_ns())
    times.now += int(PING_EVERY * 1e9)
    ping = here.ping(THERE)
    if ping is None:
        return None
    times.now, times.ahead = times.now + out, ahead
    answer = there.heard(json.loads(json.dumps(ping)), HERE, times.time_ns())
    times.now, times.ahead = times.now + back, 0
    assert answer
    assert here.heard(json.loads(json.dumps(answer)), THERE, times.time_ns()) is None
    return answer


def test_a_clock_that_is_ahead_is_found_within_its_uncertainty(times: Times) -> None:
    here, there, ahead = Clock("one"), Clock("two"), 250_000_000
    assert here.offset(THERE) is None
    for out, back in ((9_000_000, 1_000_000), (1_000_000, 1_200_000), (2_000_000, 30_000_000)):
        exchange(times, here, there, ahead, out, back)
    found = here.offset(THERE)
    assert found
    assert abs(found[0] - ahead) <= found[1] == 1_100_000  # of the quickest exchange
    assert here.offset(THERE[:12] + b"2222") == found  # another publisher of that process


def test_processes_of_one_machine_are_asked_once(times: Times) -> None:
    here, there = Clock("one"), Clock("one")
    assert exchange(times, here, there, 0, 10_000, 20_000)
    assert here.offset(THERE) == (0, 0)
    assert exchange(times, here, there, 0, 10_000, 20_000) is None


def test_who_is_new_is_asked_often_until_enough_is_known(times: Times) -> None:
    here, there = Clock("one"), Clock("two")
    for known, own in ((here, HERE), (there, THERE)):
        known.heard(known.hello() or {}, own, times.time_ns())
    asked_at = []
    for _ in range(200):
        if ping := here.ping(THERE):
            asked_at.append(times.monotonic())
            here.heard(there.heard(ping, HERE, times.time_ns()) or {}, THERE, times.time_ns())
        times.now += 10**8
    pauses = [after - before for before, after in itertools.pairwise(asked_at)]
    assert pauses == pytest.approx([PING_AT_FIRST] * (KEPT - 1) + [PING_EVERY] * 2, abs=0.11)


def test_who_does_not_answer_is_not_asked_for_ever(times: Times) -> None:
    here = Clock("one")
    asked = 0
    for _ in range(100):
        asked += here.ping(THERE) is not None
        times.now += int(PING_EVERY * 1e9)
    assert asked == TRIES
    assert here.offset(THERE) is None


def test_a_clock_that_was_set_is_told_and_what_was_known_is_forgotten(times: Times) -> None:
    here, there = Clock("one"), Clock("two")
    exchange(times, here, there, 0, 10, 10)
    times.now += 10**9
    assert here.jump() == 0
    times.ahead = -3_000_000_000
    assert here.jump() == -3
    assert here.offset(THERE) is None
    assert here.jump() == 0


@pytest.mark.parametrize("told", [{}, {"to": 1}, {"to": "x", "from": "y"}, {"host": "h"}, {"host": "h", "to": None}])
def test_messages_of_others_are_left(told: dict[str, Any]) -> None:
    assert Clock().heard(told, HERE, 0) is None
