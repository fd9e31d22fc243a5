"""Alarm rules: hysteresis and hold times, metrics, errors in rule files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from scan2sim.pipeline.core.errors import InputError
from scan2sim.services.monitoring.events.broker_contact import RESEND_S, BrokerContact, NoBroker
from scan2sim.services.monitoring.events.rule_evaluator import RuleEvaluator
from scan2sim.services.monitoring.events.rules import Rule, read
from scan2sim.services.monitoring.events.schema import Alarm, AlarmCommand, QueueState


def record(node: str, time: float, *flows: dict[str, Any], subscribes: tuple[str, ...] = ()) -> dict[str, Any]:
    own = [{"node name": node}]
    endpoints = [{"topic name": topic, "subscriptions_info_by_topic": own} for topic in subscribes]
    return {
        "node name": node, "node namespace": "/", "time": time, "period": 1.0, "flows": flows,
        "topics endpoint info": endpoints,
    }  # fmt: skip


def evaluator_of(*rules: Rule) -> RuleEvaluator:
    return RuleEvaluator(rules, NoBroker(0.0, "records"))


def check(evaluator: RuleEvaluator, content: dict[str, Any], arrived: float | None = None) -> list[Alarm]:
    """Alarms by a record that arrives at its own time unless `arrived` is given."""
    return evaluator.check_record(content, content["time"] if arrived is None else arrived)


def flow(direction: str, **values: Any) -> dict[str, Any]:
    named = {"latency": "latency (nanoseconds)", "lost": "lost messages"}
    return {"topic": "/camera", "direction": direction, "bandwidth": 0.0, "messages": 10} | {
        named.get(name, name): value for name, value in values.items()
    }


def alarms_of(rule: Rule, latencies: list[float]) -> list[tuple[int, str]]:
    """(second, state) of the alarms caused by a series of latencies, one record per second."""
    evaluator = evaluator_of(rule)
    return [
        (second, alarm.state)
        for second, latency in enumerate(latencies)
        for alarm in check(evaluator, record("hears", second, flow("incoming", latency=int(latency * 1e9))))
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
    evaluator = evaluator_of(Rule(name="slow", metric="rate", below=8, hold=2, topic="/cam*"))
    alarms = [one for t in range(4) for one in check(evaluator, record("hears", t, flow("incoming", messages=5)))]
    assert alarms == [Alarm(state="raised", rule="slow", subject="/camera at /hears", value=5, since=0)]


def test_rules_on_losses_queues_and_silence() -> None:
    evaluator = evaluator_of(
        Rule(name="lost", metric="lost", above=4), Rule(name="queue", metric="queue_length", above=100),
        Rule(name="silent", metric="silence", above=5),
    )  # fmt: skip
    assert [one.rule for one in check(evaluator, record("hears", 0, flow("incoming", lost=5)))] == ["lost"]
    state = QueueState(queue="/cars", seconds=1, arrived=0, done=0, rejected=0, waiting=101, oldest=0, oldest_done=0,
                       workers=1)  # fmt: skip
    assert [(one.rule, one.subject) for one in evaluator.check_queue(state, 1.0)] == [("queue", "/cars")]
    assert evaluator.check_silence(4.0) == []
    assert [one.subject for one in evaluator.check_silence(6.0)] == ["/hears"]
    assert [(one.rule, one.state) for one in check(evaluator, record("hears", 7))] == [("silent", "cleared")]


@pytest.mark.parametrize(("arrives", "raised"), [(1.0, False), (0.5, True), (None, True)])
def test_bandwidths_of_publishers_and_subscribers_are_compared(arrives: float | None, raised: bool) -> None:
    evaluator = evaluator_of(Rule(name="differs", metric="bandwidth_difference", above=0.2, hold=2))
    found: list[Alarm] = []
    for t in range(10):
        for talker in ("left", "right"):  # two publishers of one topic, whose periods begin apart
            found += check(evaluator, record(talker, t + 0.3, flow("outgoing", bandwidth=500.0)))
        received = [flow("incoming", bandwidth=1000.0 * arrives)] if arrives is not None else []
        found += check(evaluator, record("hears", t + 0.6, *received, subscribes=("/camera",)))
    assert [one.subject for one in found] == ["/camera at /hears"] * raised
    if raised:
        assert found[0].value == pytest.approx(1 - (arrives or 0.0))


SILENT = Rule(name="silent", metric="silence", above=3)


def reach(contact: BrokerContact, now: float) -> None:
    """The brokers give a sign, and have assigned the topics."""
    contact.reached(now)
    contact.assigned("records", now)
    contact.assigned("events", now)


def states(alarms: list[Alarm]) -> list[tuple[str, str, str]]:
    return [(one.state, one.rule, one.subject) for one in alarms]


def test_silence_is_measured_by_arrival_not_by_the_clock_of_the_node() -> None:
    evaluator, found = evaluator_of(SILENT), []
    for t in range(60):  # a node whose clock is seven seconds slow, another whose clock is an hour fast
        for node, skew in (("slow", -7.0), ("fast", 3600.0)):
            found += check(evaluator, record(node, t + skew), float(t))
        found += evaluator.check_silence(t + 0.5)
    assert found == []
    assert states(evaluator.check_silence(63.0)) == [("raised", "silent", "/slow"), ("raised", "silent", "/fast")]


def test_outage_of_kafka_is_one_alarm_and_no_silence_of_the_nodes() -> None:
    contact = BrokerContact(0.0, "records", "events")
    evaluator, found = RuleEvaluator([SILENT], contact), []

    def second(t: int, *, kafka: bool, nodes: int) -> None:
        if kafka:
            reach(contact, float(t))
            for number in range(nodes):
                found.extend(check(evaluator, record(f"node{number}", t)))
        found.extend(evaluator.check_silence(t + 0.9))

    for t in range(20):
        second(t, kafka=True, nodes=20)
    for t in range(20, 80):
        second(t, kafka=False, nodes=20)
    for t in range(80, 84):  # Kafka is back, the nodes only after their pause
        second(t, kafka=True, nodes=0)
    for t in range(84, 100):
        second(t, kafka=True, nodes=20)
    outage = "Kafka is unreachable"
    assert states(found) == [("raised", outage, "Kafka"), ("cleared", outage, "Kafka")]
    for t in range(100, 110):  # a node that really is silent is found, before and after an outage
        second(t, kafka=True, nodes=19)
    assert states(found)[2:] == [("raised", "silent", "/node19")]


def test_node_that_stays_away_after_an_outage_of_kafka_is_silent() -> None:
    contact = BrokerContact(0.0, "records", "events")
    evaluator = RuleEvaluator([SILENT], contact)
    reach(contact, 1.0)
    check(evaluator, record("camera", 1.0))
    reach(contact, 61.0)
    found = []
    for t in range(62, 80):
        reach(contact, float(t))
        found += [(t, one.subject) for one in evaluator.check_silence(float(t))]
    ((raised, subject),) = found
    assert subject == "/camera" and 61 + RESEND_S + 3 <= raised <= 61 + RESEND_S + 5


@pytest.mark.parametrize("began", [0.0, 100.0], ids=["restarted", "after an outage"])
def test_silence_is_not_counted_before_kafka_assigns_the_topic_of_records(began: float) -> None:
    contact = BrokerContact(0.0, "records", "events")
    evaluator = RuleEvaluator([SILENT], contact)
    if began:
        reach(contact, 1.0)
        check(evaluator, record("camera", 1.0))
        check(evaluator, record("lidar", 1.0))
    else:
        evaluator.restore({"alarms": [], "nodes": {"/camera": -1.0, "/lidar": -1.0}, "muted": []})
    found, assigned = [], int(began + RESEND_S + 20)  # another member of the group delays the assignment
    for t in range(int(began), assigned + 20):
        contact.reached(float(t))
        if t >= assigned:
            contact.assigned("records", float(t))
            found += check(evaluator, record("camera", float(t)))
        found += [one for one in evaluator.check_silence(t + 0.1) if one.rule == "silent"]
    assert states(found) == [("raised", "silent", "/lidar")]
    assert assigned + 3 < found[0].since <= assigned + 5


def test_topic_that_reachable_brokers_do_not_assign_raises_an_alarm() -> None:
    contact = BrokerContact(0.0, "records", "events")
    evaluator, found = RuleEvaluator([SILENT], contact), []
    for t in range(300):
        if not 50 <= t < 150:  # an outage, which doesn't count
            contact.reached(float(t))
            contact.assigned("records", float(t))
        if t >= 230:
            contact.assigned("events", float(t))
        found += [(t, *state) for state in states(evaluator.check_silence(t + 0.1))]
    outage, unassigned = "Kafka is unreachable", "Kafka doesn't assign the topic"
    assert found == [
        (54, "raised", outage, "Kafka"), (150, "cleared", outage, "Kafka"),
        (211, "raised", unassigned, "events"), (230, "cleared", unassigned, "events"),
    ]  # fmt: skip


def test_slow_assignment_raises_no_alarm() -> None:
    contact = BrokerContact(0.0, "records", "events")
    evaluator = RuleEvaluator([SILENT], contact)
    for t in range(200):
        contact.reached(float(t))
        if t > 50:  # another member of the group delays it
            reach(contact, float(t))
        assert evaluator.check_silence(t + 0.1) == []


def test_node_heard_by_ros_is_watched_during_an_outage_of_kafka() -> None:
    contact = BrokerContact(0.0, "records", "events")
    evaluator = RuleEvaluator([SILENT], contact)
    for t in range(30):
        check(evaluator, record("near", t))
    assert ("raised", "silent", "/near") in states(evaluator.check_silence(40.0))


def test_restarted_evaluator_continues_without_raising_or_clearing_twice() -> None:
    first = evaluator_of(SILENT, Rule(name="lost", metric="lost", above=4))
    check(first, record("camera", 0))
    check(first, record("hears", 0, flow("incoming", lost=9)))
    assert len(first.check_silence(10.0)) == 2
    second = RuleEvaluator([SILENT, Rule(name="lost", metric="lost", above=4)], NoBroker(100.0, "records"))
    second.restore(json.loads(json.dumps(first.saved())))
    assert [second.check_silence(100.0 + t) for t in range(1, 20)] == [[]] * 19
    assert states(check(second, record("camera", 121))) == [("cleared", "silent", "/camera")]
    assert check(second, record("camera", 122)) == []
    found = check(second, record("hears", 122, flow("incoming", lost=9)))
    assert states(found) == [("cleared", "silent", "/hears")]  # and the losses aren't raised again


def test_raised_alarm_is_acknowledged_and_its_node_retired() -> None:
    evaluator = evaluator_of(SILENT)
    check(evaluator, record("camera", 0))
    check(evaluator, record("lidar", 0))
    evaluator.check_silence(10.0)
    acknowledge = AlarmCommand(action="acknowledge", rule="silent", subject="/camera", by="Ada")
    assert [(one.subject, one.state, one.acknowledged_by) for one in evaluator.command(acknowledge, 11.0)] == [
        ("/camera", "raised", "Ada")
    ]
    assert states(evaluator.command(AlarmCommand(action="retire", subject="/camera"), 12.0)) == [
        ("cleared", "silent", "/camera")
    ]
    assert evaluator.check_silence(20.0) == []
    assert states(check(evaluator, record("lidar", 21))) == [("cleared", "silent", "/lidar")]


def test_muted_alarms_are_marked_until_the_end_of_muting() -> None:
    evaluator = evaluator_of(Rule(name="lost", metric="lost", above=4))
    evaluator.command(AlarmCommand(action="mute", rule="lost", subject="* at /hears", until=100.0), 0.0)
    found = []
    for t, lost in {50: 9, 60: 0, 150: 9}.items():
        found += check(evaluator, record("hears", t, flow("incoming", lost=lost)))
    assert [(one.state, one.muted_until) for one in found] == [("raised", 100.0), ("cleared", 100.0), ("raised", 0.0)]


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
        ("rules = []\n[notify]\nemail = ['nobody']\n", "notify.email"),
        ("rules = []\n[notify]\nwebhok = 'x'\n", "notify.webhok: unknown setting"),
    ],
)
def test_invalid_rule_files_are_rejected(text: str, cause: str, tmp_path: Path) -> None:
    (tmp_path / "rules.toml").write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        read(tmp_path / "rules.toml")
    assert str(caught.value.where) == str(tmp_path / "rules.toml")
    assert cause in caught.value.cause and caught.value.remedy
