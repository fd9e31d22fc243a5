"""Runs and alarms as a page shows them: what became of them last, within bounds; what is no event is counted."""

from __future__ import annotations

import json
import time
from typing import Any

import pytest

from scan2sim.services.monitoring.dashboard import alarms, queues, runs
from scan2sim.services.monitoring.dashboard.alarms import Raised
from scan2sim.services.monitoring.dashboard.history import Refused
from scan2sim.services.monitoring.dashboard.queues import Queues
from scan2sim.services.monitoring.dashboard.runs import Runs
from scan2sim.services.monitoring.dashboard.state import Noticed
from scan2sim.services.monitoring.events.schema import Alarm, Event, QueueState, RunState, StepState

NOW = 1e9


def run(name: str, state: Any = "running", **more: Any) -> RunState:
    counts = dict.fromkeys(("steps", "running", "done", "kept", "failed"), 0)
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


def test_a_run_that_falls_silent_is_shown_as_such_and_one_that_ended_is_not() -> None:
    known = Runs()
    known.take(run("r"), NOW)
    assert not shown(known, NOW + runs.SILENT)["silent"] and shown(known, NOW + runs.SILENT + 1)["silent"]
    known.take(run("r", "done"), NOW + 5)
    assert not shown(known, NOW + 1000)["silent"]


def queue(name: str, seconds: float = 2.0) -> QueueState:
    return QueueState(
        queue=name, seconds=seconds, arrived=10, done=6, refused=3, waiting=4, oldest=0, oldest_done=0.2, workers=1
    )


def test_a_queue_is_told_a_second_and_one_that_falls_silent_is_shown_as_such() -> None:
    known = Queues()
    known.take(queue("detect"), NOW)
    (one,) = known.state(NOW + 3)
    assert (one["arrived"], one["done"], one["refused"], one["waiting"]) == (5, 3, 1.5, 4) and not one["silent"]
    assert known.state(NOW + queues.SILENT + 3)[0]["silent"]


def test_queues_have_bounds_and_silent_ones_make_room() -> None:
    known = Queues()
    for number in range(queues.QUEUES):
        known.take(queue(f"q{number}"), NOW + number)
    with pytest.raises(Refused, match="queues"):
        known.take(queue("new"), NOW + 20)
    known.take(queue("q0"), NOW + 20)
    known.take(queue("new"), NOW + 100)
    names = {one["queue"] for one in known.state(NOW)}
    assert len(names) == queues.QUEUES and {"new", "q0"} <= names and "q1" not in names


def test_what_runs_and_what_failed_comes_first_and_the_rest_is_counted() -> None:
    known = Runs()
    for number in range(100):
        known.take(step(f"s{number}", "done"), NOW)
    known.take(step("broken", "failed", message="why"), NOW)
    known.take(step("s3", "waiting"), NOW)
    known.take(step("s3", "running", progress=0.5), NOW)
    names = [one["step"] for one in shown(known)["details"]["steps"]]
    assert names[:4] == ["s3", "broken", "s99", "s98"] and len(names) == runs.SHOWN
    known.take(step("later", "waiting"), NOW)
    known.take(step("before", "kept"), NOW)
    details = shown(known)["details"]
    assert details["known"] == 103
    assert details["others"] == {"done": 100 - 1 - (runs.SHOWN - 2), "waiting": 1, "kept": 1}


def test_a_worker_that_is_heard_late_does_not_undo_an_end() -> None:
    known = Runs()
    known.take(step("a", "running", host="worker"), NOW)
    known.take(step("a", "done", seconds=3.0), NOW)
    known.take(step("a", "running", host="worker"), NOW)
    assert states(known) == {"a": "done"}
    assert shown(known)["details"]["steps"][0]["host"] == "worker", "the flow doesn't know it"
    known.take(step("a", "waiting"), NOW)  # its result was damaged
    known.take(step("a", "running", host="other"), NOW)
    assert states(known) == {"a": "running"}


def test_the_version_grows_with_what_is_known() -> None:
    known = Runs()
    known.take(run("r"), NOW)
    first = shown(known)["version"]
    assert shown(known, NOW + 1)["version"] == first
    known.take(step("a", "running"), NOW)
    assert shown(known)["version"] > first


def test_runs_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runs, "STEPS", 3)
    known = Runs()
    for number in range(runs.RUNS):
        known.take(run(f"r{number}"), NOW + number)
    now = NOW + runs.SILENT
    with pytest.raises(Refused, match="no room"):
        known.take(run("more"), now)
    known.take(run("r5", "done"), now)
    known.take(run("more"), now)
    assert {one["run"] for one in known.state(now)} == {f"r{n}" for n in range(runs.RUNS) if n != 5} | {"more"}
    other = Runs()
    for name in "abc":
        other.take(step(name, "waiting"), NOW)
    with pytest.raises(Refused, match="no room"):
        other.take(step("d", "waiting"), NOW)


def test_an_alarm_is_raised_until_it_is_cleared() -> None:
    known = Raised()
    known.take(alarm("raised", since=NOW), NOW + 5)
    known.take(alarm("raised", "lost", since=NOW + 8), NOW + 9)
    known.take(alarm("raised", since=NOW + 20, value=3.0), NOW + 21)  # by a rules' node that was started anew
    assert [(one["rule"], one["since"], one["value"]) for one in known.state()["raised"]] == [
        ("lost", NOW + 8, 1.0),
        ("late", NOW, 3.0),
    ]
    known.take(alarm("cleared", since=NOW + 30, value=0.1), NOW + 40)
    (cleared,) = known.state()["cleared"]
    assert (cleared["since"], cleared["until"], cleared["value"]) == (NOW, NOW + 40, 3.0)
    assert [one["rule"] for one in known.state()["raised"]] == ["lost"]
    known.take(alarm("cleared", "never heard of"), NOW + 41)
    assert known.state()["cleared"][0]["since"] is None


def test_alarms_are_bounded() -> None:
    known = Raised()
    for number in range(alarms.RAISED):
        known.take(alarm("raised", f"rule {number}"), NOW)
    with pytest.raises(Refused, match="no room"):
        known.take(alarm("raised", "one more"), NOW)
    for number in range(alarms.RAISED):
        known.take(alarm("cleared", f"rule {number}"), NOW)
    assert len(known.state()["cleared"]) == alarms.CLEARED and not known.state()["raised"]


def body(**changed: Any) -> bytes:
    told = Event(id="a:1", time=NOW, sender="test", kind="run", body=run("r").model_dump())
    return json.dumps(json.loads(told.json_line()) | changed).encode()


@pytest.mark.parametrize(
    ("said", "why"),
    [
        (b"", "no event"),
        (b"\xff\xfe", "no event"),
        (b"[1, 2]", "no event"),
        (b"[" * 100_000, "no event"),
        (body(schema="other"), "no event"),
        (body(body={}), "no event"),
        (body(body=run("r").model_dump() | {"seconds": -1}), "no event"),
        (body(body=run("r").model_dump() | {"more": 1}), "no event"),
        (body(time=float("nan")), "no event"),
        (body(time=-5), "no event"),
        (body(time=1e300), "no event"),
        (body(more=4 * 2**20 * "x"), "too large"),
    ],
)
def test_what_is_no_event_is_counted_and_nothing_else_happens(said: bytes, why: str) -> None:
    noticed = Noticed(NOW)
    noticed.take(said)
    assert noticed.counts == {why: 1} and noticed.last_refused.startswith(why)
    noticed.take(body())
    state = noticed.state(time.time())
    assert len(state["runs"]) == 1
    assert json.loads(json.dumps(state, allow_nan=False)) == state


def test_other_programs_events_are_left() -> None:
    noticed = Noticed(NOW)
    noticed.take(body(kind="count", body={"vehicles": 3}))
    assert not noticed.counts and not noticed.state(NOW)["runs"]


def test_what_happened_before_the_page_is_from_back_then() -> None:
    noticed = Noticed(NOW)
    noticed.take(body(time=NOW - 100))
    assert noticed.state(NOW)["runs"][0]["silent"] and noticed.state(NOW)["runs"][0]["came"] == NOW - 100
