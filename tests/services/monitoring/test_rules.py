"""Rules: alarms are raised when something lasts, cleared when it is over for good; what is no rule is told."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from scan2sim.pipeline.core.errors import InputError
from scan2sim.services.monitoring.events.rules import Alarms, Rule, read
from scan2sim.services.monitoring.events.schema import Alarm, QueueState


def record(node: str, time: float, *flows: dict[str, Any], subscribes: tuple[str, ...] = ()) -> dict[str, Any]:
    own = [{"node name": node}]
    endpoints = [{"topic name": topic, "subscriptions_info_by_topic": own} for topic in subscribes]
    return {
        "node name": node, "node namespace": "/", "time": time, "period": 1.0, "flows": flows,
        "topics endpoint info": endpoints,
    }  # fmt: skip


def flow(direction: str, **said: Any) -> dict[str, Any]:
    named = {"latency": "latency (nanoseconds)", "lost": "lost messages"}
    return {"topic": "/camera", "direction": direction, "bandwidth": 0.0, "messages": 10} | {
        named.get(name, name): value for name, value in said.items()
    }


def latencies(rule: Rule, series: list[float]) -> list[tuple[int, str]]:
    """When, and what alarms come of latencies, of one record a second."""
    alarms = Alarms([rule])
    return [
        (second, alarm.state)
        for second, latency in enumerate(series)
        for alarm in alarms.record(record("hears", second, flow("incoming", latency=int(latency * 1e9))))
    ]


def test_what_is_short_raises_nothing_and_what_lasts_does() -> None:
    rule = Rule(name="late", metric="latency", above=0.2, hold=3)
    assert latencies(rule, [0.1, 0.9, 0.9, 0.1, 0.9, 0.9, 0.1]) == []
    assert latencies(rule, [0.1, 0.3, 0.3, 0.3, 0.3, 0.3]) == [(4, "raised")]


def test_an_alarm_does_not_flutter_about_its_bound() -> None:
    rule = Rule(name="late", metric="latency", above=0.2, clear=0.1, clear_hold=2)
    series = [0.3, 0.19, 0.21, 0.15, 0.05, 0.15, 0.05, 0.05, 0.05, 0.3]
    assert latencies(rule, series) == [(0, "raised"), (8, "cleared"), (9, "raised")]


def test_an_alarm_says_since_when() -> None:
    alarms = Alarms([Rule(name="slow", metric="rate", below=8, hold=2, topic="/cam*")])
    told = [one for t in range(4) for one in alarms.record(record("hears", t, flow("incoming", messages=5)))]
    assert told == [Alarm(state="raised", rule="slow", subject="/camera at /hears", value=5, since=0)]


def test_losses_queues_and_silence() -> None:
    alarms = Alarms([
        Rule(name="lost", metric="lost", above=4), Rule(name="queue", metric="queue_length", above=100),
        Rule(name="silent", metric="silence", above=5),
    ])  # fmt: skip
    assert [one.rule for one in alarms.record(record("hears", 0, flow("incoming", lost=5)))] == ["lost"]
    state = QueueState(queue="/cars", seconds=1, arrived=0, done=0, refused=0, waiting=101, oldest=0, oldest_done=0,
                       workers=1)  # fmt: skip
    assert [(one.rule, one.subject) for one in alarms.queue(state, 1.0)] == [("queue", "/cars")]
    assert alarms.tick(4.0) == [] and [one.subject for one in alarms.tick(6.0)] == ["/hears"]
    assert [(one.rule, one.state) for one in alarms.record(record("hears", 7))] == [("silent", "cleared")]


@pytest.mark.parametrize(("arrives", "raised"), [(1.0, False), (0.5, True), (None, True)])
def test_publishers_and_subscribers_are_compared(arrives: float | None, raised: bool) -> None:
    alarms, found = Alarms([Rule(name="differs", metric="bandwidth_difference", above=0.2, hold=2)]), []
    for t in range(10):
        for talker in ("left", "right"):  # two publishers of one topic, whose periods begin apart
            found += alarms.record(record(talker, t + 0.3, flow("outgoing", bandwidth=500.0)))
        heard = [flow("incoming", bandwidth=1000.0 * arrives)] if arrives is not None else []
        found += alarms.record(record("hears", t + 0.6, *heard, subscribes=("/camera",)))
    assert [one.subject for one in found] == ["/camera at /hears"] * raised
    if raised:
        assert found[0].value == pytest.approx(1 - (arrives or 0.0))


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        ("[[rules]\n", "not valid TOML"),
        ("rule = 3\n", "no list of rules"),
        ("[[rules]]\nmetric = 'latency'\nabove = 1\n", "rule 1.name: is missing"),
        ("[[rules]]\nname = 'late'\nmetric = 'lateness'\nabove = 1\n", "rule 'late'.metric: must be bandwidth_"),
        ("[[rules]]\nname = 'late'\nmetric = 'latency'\nabove = 'x'\n", "rule 'late'.above: must be"),
        ("[[rules]]\nname = 'late'\nmetric = 'latency'\n", "rule 'late': needs one bound"),
        ("[[rules]]\nname = 'late'\nmetric = 'latency'\nabove = 1\nbelow = 2\n", "rule 'late': needs one bound"),
        ("[[rules]]\nname = 'late'\nmetric = 'latency'\nabove = 1\nclear = 2\n", "rule 'late'.clear: would clear"),
        ("[[rules]]\nname = 'late'\nmetric = 'latency'\nabov = 1\n", "rule 'late'.abov: there is no such setting"),
        ("[[rules]]\nname = 'a'\nmetric = 'lost'\nabove = 1\n" * 2, "two rules are called 'a'"),
    ],
)
def test_what_is_no_rule_is_told(text: str, cause: str, tmp_path: Path) -> None:
    (tmp_path / "rules.toml").write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        read(tmp_path / "rules.toml")
    assert str(caught.value.where) == str(tmp_path / "rules.toml")
    assert cause in caught.value.cause and caught.value.remedy
