"""Alarm rules: hysteresis and hold times, metrics, errors in rule files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from scan2sim.pipeline.core.errors import InputError
from scan2sim.services.monitoring.events.rules import Rule, RuleEvaluator, read
from scan2sim.services.monitoring.events.schema import Alarm, QueueState


def record(node: str, time: float, *flows: dict[str, Any], subscribes: tuple[str, ...] = ()) -> dict[str, Any]:
    own = [{"node name": node}]
    endpoints = [{"topic name": topic, "subscriptions_info_by_topic": own} for topic in subscribes]
    return {
        "node name": node, "node namespace": "/", "time": time, "period": 1.0, "flows": flows,
        "topics endpoint info": endpoints,
    }  # fmt: skip


def flow(direction: str, **values: Any) -> dict[str, Any]:
    named = {"latency": "latency (nanoseconds)", "lost": "lost messages"}
    return {"topic": "/camera", "direction": direction, "bandwidth": 0.0, "messages": 10} | {
        named.get(name, name): value for name, value in values.items()
    }


def alarms_of(rule: Rule, latencies: list[float]) -> list[tuple[int, str]]:
    """(second, state) of the alarms caused by a series of latencies, one record per second."""
    evaluator = RuleEvaluator([rule])
    return [
        (second, alarm.state)
        for second, latency in enumerate(latencies)
        for alarm in evaluator.check_record(record("hears", second, flow("incoming", latency=int(latency * 1e9))))
    ]


def test_alarm_is_raised_only_after_the_hold_time() -> None:
    rule = Rule(name="late", metric="latency", above=0.2, hold=3)
    assert alarms_of(rule, [0.1, 0.9, 0.9, 0.1, 0.9, 0.9, 0.1]) == []
    assert alarms_of(rule, [0.1, 0.3, 0.3, 0.3, 0.3, 0.3]) == [(4, "raised")]


def test_hysteresis_prevents_flapping_around_the_threshold() -> None:
    rule = Rule(name="late", metric="latency", above=0.2, clear=0.1, clear_hold=2)
    series = [0.3, 0.19, 0.21, 0.15, 0.05, 0.15, 0.05, 0.05, 0.05, 0.3]
    assert alarms_of(rule, series) == [(0, "raised"), (8, "cleared"), (9, "raised")]


def test_alarm_has_the_start_of_the_violation() -> None:
    evaluator = RuleEvaluator([Rule(name="slow", metric="rate", below=8, hold=2, topic="/cam*")])
    alarms = [one for t in range(4) for one in evaluator.check_record(record("hears", t, flow("incoming", messages=5)))]
    assert alarms == [Alarm(state="raised", rule="slow", subject="/camera at /hears", value=5, since=0)]


def test_rules_on_losses_queues_and_silence() -> None:
    evaluator = RuleEvaluator([
        Rule(name="lost", metric="lost", above=4), Rule(name="queue", metric="queue_length", above=100),
        Rule(name="silent", metric="silence", above=5),
    ])  # fmt: skip
    assert [one.rule for one in evaluator.check_record(record("hears", 0, flow("incoming", lost=5)))] == ["lost"]
    state = QueueState(queue="/cars", seconds=1, arrived=0, done=0, refused=0, waiting=101, oldest=0, oldest_done=0,
                       workers=1)  # fmt: skip
    assert [(one.rule, one.subject) for one in evaluator.check_queue(state, 1.0)] == [("queue", "/cars")]
    assert evaluator.check_silence(4.0) == []
    assert [one.subject for one in evaluator.check_silence(6.0)] == ["/hears"]
    assert [(one.rule, one.state) for one in evaluator.check_record(record("hears", 7))] == [("silent", "cleared")]


@pytest.mark.parametrize(("arrives", "raised"), [(1.0, False), (0.5, True), (None, True)])
def test_bandwidths_of_publishers_and_subscribers_are_compared(arrives: float | None, raised: bool) -> None:
    evaluator = RuleEvaluator([Rule(name="differs", metric="bandwidth_difference", above=0.2, hold=2)])
    found: list[Alarm] = []
    for t in range(10):
        for talker in ("left", "right"):  # two publishers of one topic, whose periods begin apart
            found += evaluator.check_record(record(talker, t + 0.3, flow("outgoing", bandwidth=500.0)))
        received = [flow("incoming", bandwidth=1000.0 * arrives)] if arrives is not None else []
        found += evaluator.check_record(record("hears", t + 0.6, *received, subscribes=("/camera",)))
    assert [one.subject for one in found] == ["/camera at /hears"] * raised
    if raised:
        assert found[0].value == pytest.approx(1 - (arrives or 0.0))


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        ("[[rules]\n", "not valid TOML"),
        ("rule = 3\n", "not a list of rules"),
        ("[[rules]]\nmetric = 'latency'\nabove = 1\n", "rule 1.name: is missing"),
        ("[[rules]]\nname = 'late'\nmetric = 'lateness'\nabove = 1\n", "rule 'late'.metric: must be bandwidth_"),
        ("[[rules]]\nname = 'late'\nmetric = 'latency'\nabove = 'x'\n", "rule 'late'.above: must be"),
        ("[[rules]]\nname = 'late'\nmetric = 'latency'\n", "rule 'late': needs exactly one threshold"),
        (
            "[[rules]]\nname = 'late'\nmetric = 'latency'\nabove = 1\nbelow = 2\n",
            "rule 'late': needs exactly one threshold",
        ),
        (
            "[[rules]]\nname = 'late'\nmetric = 'latency'\nabove = 1\nclear = 2\n",
            "rule 'late'.clear: the value at which the alarm clears would raise it",
        ),
        ("[[rules]]\nname = 'late'\nmetric = 'latency'\nabov = 1\n", "rule 'late'.abov: unknown setting"),
        ("[[rules]]\nname = 'a'\nmetric = 'lost'\nabove = 1\n" * 2, "two rules have the name 'a'"),
    ],
)
def test_invalid_rule_files_are_rejected(text: str, cause: str, tmp_path: Path) -> None:
    (tmp_path / "rules.toml").write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        read(tmp_path / "rules.toml")
    assert str(caught.value.where) == str(tmp_path / "rules.toml")
    assert cause in caught.value.cause and caught.value.remedy
