"""State of runs, queues and alarms on the dashboard: latest state, bounds, rejected events."""

from __future__ import annotations

import json
import time
from typing import Any

import pytest

from scan2sim.services.monitoring.dashboard import alarms, queues, runs
from scan2sim.services.monitoring.dashboard.alarms import AlarmStates
from scan2sim.services.monitoring.dashboard.queues import Queues
from scan2sim.services.monitoring.dashboard.runs import Runs
from scan2sim.services.monitoring.dashboard.state import BusState
from scan2sim.services.monitoring.events.schema import Alarm, Event, QueueState, RunState, StepState
from scan2sim.services.monitoring.messages import RejectedError

NOW = 1e9


def run(name: str, state: Any = "running", **more: Any) -> RunState:
    counts = dict.fromkeys(("steps", "running", "done", "cached", "failed"), 0)
    return RunState(run=name, command="run", source="tile", host="edge", state=state, seconds=1, **counts | more)


def step(name: str, state: Any, **more: Any) -> StepState:
    return StepState(run="r", tile="", step=name, state=state, **more)


def alarm(state: Any, rule: str = "late", since: float = NOW, value: float = 1.0) -> Alarm:
    return Alarm(state=state, rule=rule, subject="/camera", value=value, since=since)


def shown(known: Runs, now: float = NOW) -> dict[str, Any]:
    (only,) = known.state(now)
    return only


def states(known: Runs) -> dict[str, str]:
    return {one["step"]: one["state"] for one in shown(known)["details"]["steps"]}


def test_run_counts_as_silent_unless_it_ended() -> None:
    known = Runs()
    known.add(run("r"), NOW)
    limit = runs.SILENT_AFTER_S
    assert not shown(known, NOW + limit)["silent"] and shown(known, NOW + limit + 1)["silent"]
    known.add(run("r", "done"), NOW + 5)
    assert not shown(known, NOW + 1000)["silent"]


def queue(name: str, seconds: float = 2.0) -> QueueState:
    return QueueState(
        queue=name, seconds=seconds, arrived=10, done=6, rejected=3, waiting=4, oldest=0, oldest_done=0.2, workers=1
    )


def test_queue_has_rates_per_second_and_a_silent_flag() -> None:
    known = Queues()
    known.add(queue("detect"), NOW)
    (one,) = known.state(NOW + 3)
    assert (one["arrived"], one["done"], one["rejected"], one["waiting"]) == (5, 3, 1.5, 4) and not one["silent"]
    assert known.state(NOW + queues.SILENT_AFTER_S + 3)[0]["silent"]


def test_new_queue_replaces_a_silent_one_at_the_bound() -> None:
    known = Queues()
    for number in range(queues.MAX_QUEUES):
        known.add(queue(f"q{number}"), NOW + number)
    with pytest.raises(RejectedError, match="queues"):
        known.add(queue("new"), NOW + 20)
    known.add(queue("q0"), NOW + 20)
    known.add(queue("new"), NOW + 100)
    names = {one["queue"] for one in known.state(NOW)}
    assert len(names) == queues.MAX_QUEUES and {"new", "q0"} <= names and "q1" not in names


def test_running_and_failed_tasks_are_listed_first_and_the_rest_is_counted() -> None:
    known = Runs()
    for number in range(100):
        known.add(step(f"s{number}", "done"), NOW)
    known.add(step("broken", "failed", message="why"), NOW)
    known.add(step("s3", "waiting"), NOW)
    known.add(step("s3", "running", progress=0.5), NOW)
    names = [one["step"] for one in shown(known)["details"]["steps"]]
    assert names[:4] == ["s3", "broken", "s99", "s98"] and len(names) == runs.MAX_LISTED_STEPS
    known.add(step("later", "waiting"), NOW)
    known.add(step("before", "cached"), NOW)
    details = shown(known)["details"]
    assert details["known"] == 103
    assert details["others"] == {"done": 100 - 1 - (runs.MAX_LISTED_STEPS - 2), "waiting": 1, "cached": 1}


def test_late_running_event_of_a_worker_does_not_undo_a_final_state() -> None:
    known = Runs()
    known.add(step("a", "running", host="worker"), NOW)
    known.add(step("a", "done", seconds=3.0), NOW)
    known.add(step("a", "running", host="worker"), NOW)
    assert states(known) == {"a": "done"}
    assert shown(known)["details"]["steps"][0]["host"] == "worker", "the flow doesn't know it"
    known.add(step("a", "waiting"), NOW)  # its result was damaged
    known.add(step("a", "running", host="other"), NOW)
    assert states(known) == {"a": "running"}


def test_version_increases_with_every_event() -> None:
    known = Runs()
    known.add(run("r"), NOW)
    first = shown(known)["version"]
    assert shown(known, NOW + 1)["version"] == first
    known.add(step("a", "running"), NOW)
    assert shown(known)["version"] > first


def test_number_of_runs_and_tasks_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runs, "MAX_STEPS", 3)
    known = Runs()
    for number in range(runs.MAX_RUNS):
        known.add(run(f"r{number}"), NOW + number)
    now = NOW + runs.SILENT_AFTER_S
    with pytest.raises(RejectedError, match="no room"):
        known.add(run("more"), now)
    known.add(run("r5", "done"), now)
    known.add(run("more"), now)
    assert {one["run"] for one in known.state(now)} == {f"r{n}" for n in range(runs.MAX_RUNS) if n != 5} | {"more"}
    other = Runs()
    for name in "abc":
        other.add(step(name, "waiting"), NOW)
    with pytest.raises(RejectedError, match="no room"):
        other.add(step("d", "waiting"), NOW)


def test_alarm_stays_raised_until_it_is_cleared() -> None:
    known = AlarmStates()
    known.add(alarm("raised", since=NOW), NOW + 5)
    known.add(alarm("raised", "lost", since=NOW + 8), NOW + 9)
    known.add(alarm("raised", since=NOW + 20, value=3.0), NOW + 21)  # of an alarm node that was restarted
    assert [(one["rule"], one["since"], one["value"]) for one in known.state()["raised"]] == [
        ("lost", NOW + 8, 1.0),
        ("late", NOW, 3.0),
    ]
    known.add(alarm("cleared", since=NOW + 30, value=0.1), NOW + 40)
    (cleared,) = known.state()["cleared"]
    assert (cleared["since"], cleared["until"], cleared["value"]) == (NOW, NOW + 40, 3.0)
    assert [one["rule"] for one in known.state()["raised"]] == ["lost"]
    known.add(alarm("cleared", "never heard of"), NOW + 41)
    assert known.state()["cleared"][0]["since"] is None


def test_number_of_alarms_is_bounded() -> None:
    known = AlarmStates()
    for number in range(alarms.MAX_RAISED):
        known.add(alarm("raised", f"rule {number}"), NOW)
    with pytest.raises(RejectedError, match="no room"):
        known.add(alarm("raised", "one more"), NOW)
    for number in range(alarms.MAX_RAISED):
        known.add(alarm("cleared", f"rule {number}"), NOW)
    assert len(known.state()["cleared"]) == alarms.MAX_CLEARED and not known.state()["raised"]


def body(**changed: Any) -> bytes:
    event = Event(id="a:1", time=NOW, sender="test", kind="run", body=run("r").model_dump())
    return json.dumps(json.loads(event.json_line()) | changed).encode()


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (b"", "invalid JSON"),
        (b"\xff\xfe", "invalid JSON"),
        (b"[1, 2]", "invalid event"),
        (b"[" * 100_000, "invalid JSON"),
        (body(schema="other"), "invalid event"),
        (body(body={}), "invalid event"),
        (body(body=run("r").model_dump() | {"seconds": -1}), "invalid event"),
        (body(body=run("r").model_dump() | {"more": 1}), "invalid event"),
        (body(time=float("nan")), "malformed"),
        (body(time=-5), "invalid event"),
        (body(time=1e300), "invalid event"),
        (body(more=4 * 2**20 * "x"), "too large"),
    ],
)
def test_invalid_events_are_counted_by_reason(message: bytes, reason: str) -> None:
    bus_state = BusState(NOW)
    bus_state.add(message)
    assert bus_state.rejections.counts == {reason: 1} and bus_state.rejections.last.startswith(reason)
    bus_state.add(body())
    state = bus_state.state(time.time())
    assert len(state["runs"]) == 1
    assert json.loads(json.dumps(state, allow_nan=False)) == state


def test_events_of_unknown_kinds_are_ignored() -> None:
    bus_state = BusState(NOW)
    bus_state.add(body(kind="count", body={"vehicles": 3}))
    assert not bus_state.rejections.counts and not bus_state.state(NOW)["runs"]


def test_events_before_the_start_keep_their_own_time() -> None:
    bus_state = BusState(NOW)
    bus_state.add(body(time=NOW - 100))
    assert bus_state.state(NOW)["runs"][0]["silent"] and bus_state.state(NOW)["runs"][0]["came"] == NOW - 100


def test_retirement_of_nodes_is_passed_on_with_its_time() -> None:
    retired: list[tuple[str, float]] = []
    bus_state = BusState(NOW, lambda node, at: retired.append((node, at)))
    for action in ("acknowledge", "retire"):
        command = {"action": action, "rule": "*", "subject": "/camera", "by": "Ada", "until": 0.0}
        bus_state.add(body(kind="alarm_command", body=command, time=NOW - 100))
    assert retired == [("/camera", NOW - 100)] and not bus_state.rejections.counts
