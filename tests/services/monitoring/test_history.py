"""History: what plots are made of; bounds; records that are none."""

from __future__ import annotations

import itertools
import json
import time
from typing import Any

import numpy as np
import pytest

from scan2sim.services.monitoring.dashboard import history as module
from scan2sim.services.monitoring.dashboard.history import COLUMNS, HELD, POINTS, History, buckets, grid
from tests.services.monitoring.sample_records import body, record

START = 1_700_000_000.0


def history_of(*bodies: bytes, began: float = 0.0) -> History:
    made = History(began)
    for one in bodies:
        made.take(one)
    return made


def window(of: History, seconds: float, begin: float = START, **more: Any) -> dict[str, Any]:
    return of.window(grid(begin, begin + seconds), **more)


def test_a_record_a_bucket_is_told_as_it_is() -> None:
    told = window(history_of(*(body("a", START + i + 0.5, lost=i) for i in range(5))), 5)
    assert told["step"] == 1 and told["times"] == [START + i + 0.5 for i in range(5)]
    (node,) = told["nodes"]
    assert node["name"] == "/a" and node["lost"] == {"mean": [0, 1, 2, 3, 4]}
    assert node["latency"]["mean"] == [0.002] * 5, "in seconds"
    assert told["sums"] == {"in": [2000] * 5, "out": [1000] * 5, "difference": [1000] * 5}


def test_buckets_keep_the_least_and_the_most_beside_the_mean() -> None:
    latencies = [None if i % 7 == 0 else 1_000_000 * (i % 10) for i in range(1800)]
    latencies[900] = 5_000_000_000
    told = window(history_of(*(body("a", START + i, latency=one) for i, one in enumerate(latencies))), 1800)
    (node,), step = told["nodes"], int(told["step"])
    assert step == 5 and len(told["times"]) == 360
    for i in range(0, 1800, step):
        known = [one * 1e-9 for one in latencies[i : i + step] if one is not None]
        for kind, function in (("mean", np.mean), ("min", np.min), ("max", np.max)):
            assert node["latency"][kind][i // step] == pytest.approx(function(known), abs=1e-6)
    assert max(node["latency"]["max"]) == 5


def test_unknown_is_null_and_not_zero() -> None:
    (node,) = window(history_of(body("a", START + 0.5, latency=None, lost=None)), 1)["nodes"]
    assert node["latency"]["mean"] == node["lost"]["mean"] == [None]


def test_a_record_holds_for_its_period_and_no_longer() -> None:
    told = window(history_of(body("a", START + 4.5, period=3.0), body("a", START + 20.5, period=3.0)), 21)
    there = [value is not None for value in told["nodes"][0]["bandwidth"]["mean"]]
    held = int(HELD * 3)
    assert there == [i in {*range(4 - held, 5), *range(20 - held, 21)} for i in range(21)]


def test_late_and_doubled_times_are_put_in_order() -> None:
    times = [5.5, 1.5, 3.5, 4.5, 2.5, 0.5]
    told = window(history_of(*(body("a", START + at, messages=int(at)) for at in times)), 6)
    assert told["nodes"][0]["messages"]["mean"] == [0, 1, 2, 3, 4, 5]


def test_sums_do_not_dip_where_some_nodes_have_yet_to_tell() -> None:
    bodies = [body(name, START + i + 0.5) for i in range(10) for name in "abc" if name == "a" or i < 8]
    assert window(history_of(*bodies), 10)["sums"]["in"] == [6000] * 10
    bodies = [body(name, START + i + 0.5) for i in range(20) for name in "abc" if name == "a" or i < 8]
    told = window(history_of(*bodies), 20)["sums"]["in"]
    assert told[:8] == [6000] * 8 and told[-8:] == [2000] * 8, "nodes that are gone count no more"


def test_sums_are_those_of_the_nodes_that_are_asked_for() -> None:
    of = history_of(*(body(name, START + 0.5) for name in "abc"))
    told = window(of, 1, nodes=["/a", "/c", "/unknown"])
    assert told["sums"]["in"] == [4000] and [node["name"] for node in told["nodes"]] == ["/a", "/c"]
    empty = window(of, 1, nodes=["/unknown"])
    assert empty["nodes"] == [] and empty["sums"]["difference"] == [None]


def test_buckets_are_the_same_whenever_they_are_asked_for() -> None:
    early, late = grid(START, START + 900), grid(START + 7, START + 907)
    assert len(early) <= POINTS + 2
    assert set(late[:-3]) - set(early) == set() or set(early[3:]) <= set(late)
    assert len(grid(START, START + 1e9)) <= POINTS + 2
    assert len(grid(START, START + 0.001)) >= 2


def test_random_records_match_a_slow_count() -> None:
    random = np.random.default_rng(5)
    times = START + np.sort(random.uniform(0, 600, 3000))
    rows = random.uniform(0, 100, (3000, len(COLUMNS))).astype(np.float32)
    rows[:, 0] = 0.2
    rows[random.random(rows.shape) < 0.2] = np.nan
    rows[:, 0] = 0.2
    edges = grid(START, START + 600)
    found = buckets(times, rows, edges)
    for i, (low, high) in enumerate(itertools.pairwise(edges)):
        inside = rows[(times >= low) & (times < high), 1:6].astype(float)
        for column in range(5):
            known = inside[~np.isnan(inside[:, column]), column]
            if len(known):
                assert found.mean[i, column] == pytest.approx(known.mean())
                assert (found.min[i, column], found.max[i, column]) == (known.min(), known.max())
            else:
                assert np.isnan(found.max[i, column]) or not len(inside)


@pytest.mark.parametrize(
    ("bad", "why"),
    [
        (b"", "no JSON"),
        (b"\xff\xfe", "no JSON"),
        (b"[" * 100_000, "no JSON"),
        (b"9" * 10_000, "no JSON"),
        (b"[]", "of another kind"),
        (b'{"schema": "other-1"}', "of another kind"),
        (b'{"schema": "scan2sim-monitor-1"}', "malformed"),
        (b" " * (module.LARGEST + 1), "too large"),
        (body("a", START, period=0.0), "malformed"),
        (body("a", START, messages=10**30), "malformed"),
        (body("a", START).replace(b"3000.0", b"1e999"), "malformed"),
        (body("a", START).replace(b"3000.0", b"NaN"), "malformed"),
        (body("a", START).replace(b"3000.0", b'"many"'), "malformed"),
        (body("a", 1e12), "malformed"),
        (body("a", -1.0), "malformed"),
    ],
    ids=range(15),
)
def test_what_is_no_record_is_counted_and_harms_nothing(bad: bytes, why: str) -> None:
    of = history_of(body("a", START + 0.5), bad, body("a", START + 1.5))
    state = of.state()
    assert state["counts"] == {"shown": 2, why: 1} and state["last_refused"].startswith(why)
    assert window(of, 2)["nodes"][0]["messages"]["mean"] == [3, 3]
    json.dumps(state, allow_nan=False)


def test_a_silent_node_is_gone_after_three_periods(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 1000.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    of = history_of(body("quick", START), body("slow", START, period=10.0))
    for seconds, gone in ((2.9, []), (3.1, ["/quick"]), (29, ["/quick"]), (31, ["/quick", "/slow"])):
        now = 1000.0 + seconds
        assert [node["name"] for node in of.state()["nodes"] if node["gone"]] == gone
    of.take(body("quick", START + 31))
    assert [node["gone"] for node in of.state()["nodes"]] == [False, True]


@pytest.mark.parametrize("behind", [-3600.0, -30.0, 30.0, 3600.0])
def test_a_node_whose_clock_is_off_is_shown_where_its_records_come(
    behind: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    of = History(START)
    for i in range(20):
        monkeypatch.setattr(time, "time", lambda i=i: START + i + 0.5)
        of.take(body("good", START + i + 0.4))
        of.take(body("off", START + i + 0.4 - behind))
    good, off = window(of, 20)["nodes"]
    assert off["bandwidth"] == good["bandwidth"] == {"mean": [3000.0] * 20}
    told = {node["name"]: node for node in of.state()["nodes"]}
    way = "behind" if behind > 0 else "ahead of"
    assert f"its clock is {abs(behind):.0f} s {way} this machine's" in told["/off"]["remarks"][0]
    assert not told["/good"]["remarks"] and not told["/off"]["gone"]


def test_a_node_that_ended_before_the_page_began_is_gone_at_once() -> None:
    state = history_of(body("a", START - 600), body("b", START - 1), body("c", START + 1), began=START).state()
    assert [node["gone"] for node in state["nodes"]] == [True, False, False]
    assert state["nodes"][0]["silent"] == pytest.approx(600, abs=5)


def test_memory_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "ROWS", 1000)
    monkeypatch.setattr(module, "NODES", 3)
    monkeypatch.setattr(module, "parsed", lambda told: told)
    now = 1000.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    of = History(0.0)
    for i in range(5000):
        of.take(record("a", START + i, messages=i))  # type: ignore[arg-type]
    (kept,) = of._nodes.values()
    assert len(kept.times) == 1250 and 1000 <= kept.count <= 1250
    told = of.window(grid(START + 4000, START + 5000))["nodes"][0]["messages"]
    assert (told["min"][1], told["max"][1]) == (4005, 4009)
    for name in "bcdef":
        of.take(record(name, START))  # type: ignore[arg-type]
    assert set(of._nodes) == {"/a", "/b", "/c"} and of.counts["of more than 3 nodes"] == 3
    now = 2000.0
    of.take(record("g", START))  # type: ignore[arg-type]
    assert set(of._nodes) == {"/b", "/c", "/g"}, "the one that is gone for longest makes room"
