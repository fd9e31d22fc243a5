"""History of the dashboard: time buckets, memory bounds, rejected records."""

from __future__ import annotations

import itertools
import json
import time
from typing import Any

import numpy as np
import pytest

from scan2sim.services.monitoring.dashboard import history as module
from scan2sim.services.monitoring.dashboard.history import (
    COLUMNS,
    HOLD_PERIODS,
    MAX_BUCKETS,
    History,
    bucket_edges,
    buckets,
)
from scan2sim.services.monitoring.messages import MAX_RECORD_BYTES
from scan2sim.services.monitoring.record import TopicFlow
from tests.fakes.sample_records import body, record

START = 1_700_000_000.0


def history_of(*bodies: bytes, began: float = 0.0) -> History:
    made = History(began)
    for one in bodies:
        made.add(one)
    return made


def window(of: History, seconds: float, begin: float = START, **more: Any) -> dict[str, Any]:
    return of.window(bucket_edges(begin, begin + seconds), **more)


def test_one_record_per_bucket_keeps_its_values() -> None:
    found = window(history_of(*(body("a", START + i + 0.5, lost=i) for i in range(5))), 5)
    assert found["step"] == 1 and found["times"] == [START + i + 0.5 for i in range(5)]
    (node,) = found["nodes"]
    assert node["name"] == "/a" and node["lost"] == {"mean": [0, 1, 2, 3, 4]}
    assert node["latency"]["mean"] == [0.002] * 5, "in seconds"
    assert found["sums"] == {"in": [2000] * 5, "out": [1000] * 5, "difference": [1000] * 5}


def test_buckets_have_minimum_and_maximum_beside_the_mean() -> None:
    latencies = [None if i % 7 == 0 else 1_000_000 * (i % 10) for i in range(1800)]
    latencies[900] = 5_000_000_000
    found = window(history_of(*(body("a", START + i, latency=one) for i, one in enumerate(latencies))), 1800)
    (node,), step = found["nodes"], int(found["step"])
    assert step == 5 and len(found["times"]) == 360
    for i in range(0, 1800, step):
        known = [one * 1e-9 for one in latencies[i : i + step] if one is not None]
        for kind, function in (("mean", np.mean), ("min", np.min), ("max", np.max)):
            assert node["latency"][kind][i // step] == pytest.approx(function(known), abs=1e-6)
    assert max(node["latency"]["max"]) == 5


def test_unknown_values_are_null() -> None:
    (node,) = window(history_of(body("a", START + 0.5, latency=None, lost=None)), 1)["nodes"]
    assert node["latency"]["mean"] == node["lost"]["mean"] == [None]


def test_record_covers_its_period_and_no_longer() -> None:
    found = window(history_of(body("a", START + 4.5, period=3.0), body("a", START + 20.5, period=3.0)), 21)
    known = [value is not None for value in found["nodes"][0]["bandwidth"]["mean"]]
    held = int(HOLD_PERIODS * 3)
    assert known == [i in {*range(4 - held, 5), *range(20 - held, 21)} for i in range(21)]


def test_late_records_are_sorted_by_time() -> None:
    times = [5.5, 1.5, 3.5, 4.5, 2.5, 0.5]
    found = window(history_of(*(body("a", START + at, messages=int(at)) for at in times)), 6)
    assert found["nodes"][0]["messages"]["mean"] == [0, 1, 2, 3, 4, 5]


def test_sums_hold_the_last_value_of_nodes_whose_record_is_due() -> None:
    bodies = [body(name, START + i + 0.5) for i in range(10) for name in "abc" if name == "a" or i < 8]
    assert window(history_of(*bodies), 10)["sums"]["in"] == [6000] * 10
    bodies = [body(name, START + i + 0.5) for i in range(20) for name in "abc" if name == "a" or i < 8]
    sums = window(history_of(*bodies), 20)["sums"]["in"]
    assert sums[:8] == [6000] * 8 and sums[-8:] == [2000] * 8, "nodes that are gone don't count"


def test_sums_include_only_selected_nodes() -> None:
    of = history_of(*(body(name, START + 0.5) for name in "abc"))
    found = window(of, 1, names=["/a", "/c", "/unknown"])
    assert found["sums"]["in"] == [4000] and [node["name"] for node in found["nodes"]] == ["/a", "/c"]
    empty = window(of, 1, names=["/unknown"])
    assert empty["nodes"] == [] and empty["sums"]["difference"] == [None]


def test_bucket_edges_do_not_depend_on_the_time_of_the_request() -> None:
    early, late = bucket_edges(START, START + 900), bucket_edges(START + 7, START + 907)
    assert len(early) <= MAX_BUCKETS + 2
    assert set(late[:-3]) - set(early) == set() or set(early[3:]) <= set(late)
    assert len(bucket_edges(START, START + 1e9)) <= MAX_BUCKETS + 2
    assert len(bucket_edges(START, START + 0.001)) >= 2


def test_buckets_match_a_slow_reference_on_random_records() -> None:
    random = np.random.default_rng(5)
    times = START + np.sort(random.uniform(0, 600, 3000))
    rows = random.uniform(0, 100, (3000, len(COLUMNS))).astype(np.float32)
    rows[:, 0] = 0.2
    rows[random.random(rows.shape) < 0.2] = np.nan
    rows[:, 0] = 0.2
    edges = bucket_edges(START, START + 600)
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
    ("bad", "reason"),
    [
        (b"", "invalid JSON"),
        (b"\xff\xfe", "invalid JSON"),
        (b"[" * 100_000, "invalid JSON"),
        (b"9" * 10_000, "malformed"),
        (b"[]", "unknown schema"),
        (b'{"schema": "other-1"}', "unknown schema"),
        (b'{"schema": "scan2sim-monitor-1"}', "malformed"),
        (b" " * (MAX_RECORD_BYTES + 1), "too large"),
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
def test_invalid_records_are_counted_by_reason(bad: bytes, reason: str) -> None:
    of = history_of(body("a", START + 0.5), bad, body("a", START + 1.5))
    state = of.state()
    assert state["counts"] == {"shown": 2, reason: 1} and state["last_rejected"].startswith(reason)
    assert window(of, 2)["nodes"][0]["messages"]["mean"] == [3, 3]
    json.dumps(state, allow_nan=False)


def test_silent_node_is_gone_after_three_periods(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 1000.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    of = history_of(body("quick", START), body("slow", START, period=10.0))
    for seconds, gone in ((2.9, []), (3.1, ["/quick"]), (29, ["/quick"]), (31, ["/quick", "/slow"])):
        now = 1000.0 + seconds
        assert [node["name"] for node in of.state()["nodes"] if node["gone"]] == gone
    of.add(body("quick", START + 31))
    assert [node["gone"] for node in of.state()["nodes"]] == [False, True]


@pytest.mark.parametrize("behind", [-3600.0, -30.0, 30.0, 3600.0])
def test_records_of_a_node_with_clock_skew_are_shown_at_their_arrival(
    behind: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(time, "monotonic", lambda: 1000.0)
    of = History(START)
    for i in range(20):
        monkeypatch.setattr(time, "time", lambda i=i: START + i + 0.5)
        of.add(body("good", START + i + 0.4))
        of.add(body("off", START + i + 0.4 - behind))
    good, off = window(of, 20)["nodes"]
    assert off["bandwidth"] == good["bandwidth"] == {"mean": [3000.0] * 20}
    by_name = {node["name"]: node for node in of.state()["nodes"]}
    way = "behind" if behind > 0 else "ahead of"
    assert f"its clock is {abs(behind):.0f} s {way} this machine's" in by_name["/off"]["warnings"][0]
    assert not by_name["/good"]["warnings"] and not by_name["/off"]["gone"]


def test_node_that_ended_before_the_start_is_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time, "monotonic", lambda: 1000.0)
    state = history_of(body("a", START - 600), body("b", START - 1), body("c", START + 1), began=START).state()
    assert [node["gone"] for node in state["nodes"]] == [True, False, False]
    assert state["nodes"][0]["silent"] == 600


def test_retired_node_is_not_listed_until_it_reports_again(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 1000.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    of = history_of(body("lost", START), body("other", START))
    of.retire("/lost", START + 60)
    assert len(of.state()["nodes"]) == 2, "a node that is alive can't be hidden"
    now = 1060.0
    assert [node["name"] for node in of.state()["nodes"]] == ["/other"]
    assert [node["name"] for node in window(of, 10)["nodes"]] == ["/lost", "/other"], "its past is kept"
    of.add(body("lost", START + 120))
    assert [node["name"] for node in of.state()["nodes"]] == ["/lost", "/other"]
    now = 1120.0
    assert [node["gone"] for node in of.state()["nodes"]] == [True, True], "it is gone again, but not retired again"


def test_number_of_retired_nodes_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_RETIRED", 2)
    now = 1000.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    of = history_of(*(body(name, START) for name in "abc"))
    now = 1060.0
    for number, name in enumerate("abc"):
        of.retire(f"/{name}", START + 60 + number)
    assert [node["name"] for node in of.state()["nodes"]] == ["/a"], "the first one is forgotten"


def test_memory_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_RECORDS_PER_NODE", 1000)
    monkeypatch.setattr(module, "MAX_NODES", 3)
    monkeypatch.setattr(module, "parse_record", lambda body: body)
    now = 1000.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    of = History(0.0)
    for i in range(5000):
        of.add(record("a", START + i, messages=i))  # type: ignore[arg-type]
    (kept,) = of._nodes.values()
    assert len(kept.series.times) == 1250 and 1000 <= kept.series.count <= 1250
    messages = of.window(bucket_edges(START + 4000, START + 5000))["nodes"][0]["messages"]
    assert (messages["min"][1], messages["max"][1]) == (4005, 4009)
    for name in "bcdef":
        of.add(record(name, START))  # type: ignore[arg-type]
    assert set(of._nodes) == {"/a", "/b", "/c"} and of.rejections.counts["over the limit of 3 nodes"] == 3
    now = 2000.0
    of.add(record("g", START))  # type: ignore[arg-type]
    assert set(of._nodes) == {"/b", "/c", "/g"}, "the node that has been gone for the longest is dropped"


def flow(direction: str, messages: int, **changed: Any) -> TopicFlow:
    values = {"topic": "/camera", "direction": direction, "type": "std_msgs/msg/String", "bandwidth": 100.0 * messages}
    return TopicFlow(**values | {"messages": messages, "size": 100.0} | changed)


def test_topics_are_summed_over_the_nodes_that_are_alive(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 1000.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    of = history_of(body("gone", START, flows=[flow("outgoing", 99)]))
    now += 10
    of.add(body("camera", START + 10, flows=[flow("outgoing", 10)]))
    of.add(body("near", START + 10, flows=[flow("incoming", 10, latency=1_000_000, lost=0)]))
    of.add(body("far", START + 10, flows=[flow("incoming", 5, latency=4_000_000, lost=5)]))
    (found,) = of.state()["topics"]
    assert found == {
        "topic": "/camera", "type": "std_msgs/msg/String", "publishers": 1, "subscribers": 2, "published": 10.0,
        "received": 15.0, "bandwidth": 1000.0, "latency": 0.002, "lost": 5.0, "size": 100.0, "number": 0,
    }  # fmt: skip


def test_window_by_topic_combines_publishers_and_subscribers() -> None:
    of = History(START)
    for i in range(4):
        at = START + i + 0.5
        of.add(body("camera", at, flows=[flow("outgoing", 10), flow("outgoing", 1, topic="/log")]))
        of.add(body("near", at, flows=[flow("incoming", 10, latency=1_000_000, lost=0)]))
        of.add(body("far", at, flows=[flow("incoming", 5, latency=4_000_000, lost=5)]))
        of.add(body("other", at, flows=[flow("incoming", 6, topic="/tf", latency=None, lost=None)]))
    found = window(of, 4, by="topic")
    by_name = {one.pop("name"): one for one in found["topics"]}
    assert [one.pop("number") for one in by_name.values()] == [0, 1, 2], "a colour for each topic"
    means = {name: {metric: set(one[metric]["mean"]) for metric in one} for name, one in by_name.items()}
    camera = {"bandwidth": {1000.0}, "latency": {0.002}, "lost": {5.0}, "messages": {10.0}, "size": {100.0}}
    assert means["/camera"] == camera, "sent once, though two nodes receive it"
    assert means["/tf"] == {"bandwidth": {600.0}, "latency": {None}, "lost": {None}, "messages": {6.0}, "size": {100.0}}
    assert set(found["sums"]["out"]) == {1100.0} and set(found["sums"]["in"]) == {2100.0}
    (chosen,) = window(of, 4, names=["/log"], by="topic")["topics"]
    assert chosen["name"] == "/log" and set(chosen["latency"]["mean"]) == {None}


def test_topics_that_ended_make_room_for_new_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_FLOWS", 3)
    of = history_of(body("a", START, flows=[flow("outgoing", 1, topic=f"/{i}") for i in range(5)]))
    names = [one["name"] for one in window(of, 100, by="topic")["topics"]]
    assert names == ["/0", "/1", "/2"], "no more than the limit"
    of.add(body("a", START + 2, flows=[flow("outgoing", 1, topic="/2"), flow("outgoing", 1, topic="/8")]))
    assert [one["name"] for one in window(of, 100, by="topic")["topics"]] == names, "they may continue"
    of.add(body("a", START + 4, flows=[flow("outgoing", 1, topic="/8")]))
    assert [one["name"] for one in window(of, 100, by="topic")["topics"]] == ["/2", "/8"]


def test_two_nodes_of_one_name_are_reported_but_no_restart(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 1000.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    of = History(0.0)

    def warnings(*starts: str) -> list[str]:
        nonlocal now
        for start in starts:
            now += 0.5
            of.add(body("camera", START + now, node_id=start, id=f"{start}:{int(now * 10)}"))
        (node,) = of.state()["nodes"]
        return [text for text in node["warnings"] if "name" in text]

    assert warnings("one", "one", "two", "two") == []
    assert warnings("one", "two") == ["2 nodes have this name, and their records are mixed: rename all but one"]
    assert warnings(*["two"] * 8) == []
