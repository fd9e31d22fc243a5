"""Runs on the event bus: what is told of their steps, and that no run waits for the bus, or fails because of it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from scan2sim.flows.commands.log import Log
from scan2sim.flows.commands.run_with_progress import execute_shown
from scan2sim.flows.engine import progress
from scan2sim.flows.engine.dispatch import dispatch
from scan2sim.flows.engine.execution import run_on_worker
from scan2sim.flows.engine.planning import Planned, plan
from scan2sim.flows.engine.progress import published
from scan2sim.flows.engine.versions import versions
from scan2sim.pipeline.core.cache import Store
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.services import kafka
from scan2sim.services.monitoring.events.schema import Event, RunState, StepState
from scan2sim.services.monitoring.export import event_publishers
from tests.fakes.broker import Broker
from tests.flows.toy import chain

NOBODY = "127.0.0.1:9"


class Heard:
    """An outlet that keeps what it is sent."""

    def __init__(self) -> None:
        self.events: list[Event] = []

    def send(self, told: Event) -> None:
        self.events.append(told)

    def close(self) -> None:
        pass

    def runs(self) -> list[RunState]:
        return [RunState.model_validate(one.body) for one in self.events if one.kind == "run"]

    def steps(self) -> list[StepState]:
        return [StepState.model_validate(one.body) for one in self.events if one.kind == "step"]

    def last(self) -> dict[str, StepState]:
        return {one.step: one for one in self.steps()}


@pytest.fixture
def heard(monkeypatch: pytest.MonkeyPatch) -> Heard:
    """All that is told, instead of a bus."""
    outlet = Heard()
    monkeypatch.setattr(event_publishers, "opened", lambda where: [outlet])
    return outlet


@pytest.fixture(autouse=True)
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


Run = Callable[..., None]


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Run]:
    """Runs the toy chain as commands do; keyword arguments by node."""
    source = tmp_path / "source.txt"
    source.write_text("1", encoding="utf-8")

    def go(where: str, **changes: dict[str, Any]) -> None:
        store = Store(tmp_path / "store")
        planned = plan(chain(source, tmp_path / "log", **changes), store)
        with published(where, "run", "toys") as told:
            execute_shown(planned, store, Log(tmp_path / "run.log"), 2, to_the_end=True, bus=told).check()

    yield go


def test_steps_and_their_run_are_told(run: Run, heard: Heard) -> None:
    run(NOBODY)
    assert {one.run for one in heard.steps()} == {one.run for one in heard.runs()}
    last = heard.last()
    assert set(last) == set("abcd")
    for step in last.values():
        assert step.state == "done" and step.progress == 1 and step.tile == "" and step.host
        assert step.seconds is not None and step.seconds < 60
        assert step.memory is not None and 10e6 < step.memory < 10e9
    ended = heard.runs()[-1]
    assert (ended.command, ended.source, ended.state, ended.steps, ended.done) == ("run", "toys", "done", 4, 4)


def test_what_is_kept_is_told_as_such(run: Run, heard: Heard) -> None:
    run(NOBODY)
    heard.events.clear()
    run(NOBODY, c={"value": 5})
    assert {name: step.state for name, step in heard.last().items()} == {
        "a": "kept",
        "b": "kept",
        "c": "done",
        "d": "done",
    }
    assert heard.last()["a"].seconds is None and heard.runs()[-1].kept == 2


def test_a_failure_is_told_with_its_cause(run: Run, heard: Heard) -> None:
    with pytest.raises(Exception, match="was told to fail"):
        run(NOBODY, b={"does": "fail"})
    last = heard.last()
    assert (last["b"].state, last["b"].message) == ("failed", "was told to fail")
    assert last["c"].state == "done" and last["d"].state == "waiting"
    ended = heard.runs()[-1]
    assert ended.state == "failed" and "was told to fail" in ended.message and ended.failed == 1


def test_progress_is_told_once_a_second_at_most(run: Run, heard: Heard, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "EVERY", 0.2)
    with published(NOBODY, "run", "toys") as told:
        assert told
        source = Path(__file__)
        planned = plan(chain(source, source)[:1], Store(Path("nowhere")))
        watch, began = told.steps.watching(planned, Store(Path("nowhere"))), time.monotonic()
        watch(planned[0].node, "start", 0.0, "")
        while time.monotonic() < began + 1.1:
            watch(planned[0].node, "progress", 1.5 * (time.monotonic() - began), "at\x1b[31m it " + 500 * "x")
            time.sleep(0.001)
    steps = heard.steps()
    assert 4 <= len(steps) <= 8, "though it told a thousand times"
    assert steps[-1].progress == 1.0 and len(steps[-1].message) == 400 and "\x1b" not in steps[-1].message


def test_what_runs_is_told_again_though_it_says_nothing(heard: Heard, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "EVERY", 0.05)
    monkeypatch.setattr(progress, "AGAIN", 0.2)
    with published(NOBODY, "run", "toys") as told:
        assert told
        source = Path(__file__)
        planned = plan(chain(source, source)[:2], Store(Path("nowhere")))
        told.steps.watching(planned, Store(Path("nowhere")))(planned[0].node, "start", 0.0, "")
        time.sleep(1.0)
    names = [one.step for one in heard.steps()]
    assert 4 <= names.count("a") <= 7 and names.count("b") == 1
    assert len(heard.runs()) >= 4


def test_an_interrupted_run_is_told_as_stopped(heard: Heard) -> None:
    with pytest.raises(KeyboardInterrupt), published(NOBODY, "run", "toys"):
        raise KeyboardInterrupt
    assert [one.state for one in heard.runs()] == ["stopped"]


def test_workers_elsewhere_tell_of_the_same_run(tmp_path: Path, heard: Heard) -> None:
    source, store = tmp_path / "source.txt", Store(tmp_path / "store")
    source.write_text("1", encoding="utf-8")
    planned = plan(chain(source, tmp_path / "log", c={"does": "fail"}), store)

    class Later:
        def __init__(self, pool: ThreadPoolExecutor, *arguments: Any) -> None:
            self._future = pool.submit(run_on_worker, *arguments)

        def add_done_callback(self, fn: Callable[[Any], None]) -> None:
            self._future.add_done_callback(fn)

        def result(self, *, raise_on_failure: bool) -> Any:
            return self._future.exception() or self._future.result()

    with ThreadPoolExecutor(2) as pool, published(NOBODY, "survey", "toys", here=False) as told:
        assert told
        channel, watch = told.channel, told.steps.watching(planned, store)

        def submit(item: Planned) -> Later:
            return Later(pool, item, store, None, None, versions(), channel)

        dispatch(planned, store, submit, 2, lambda *_: None, watch)
    end = time.monotonic() + 10
    while len([one for one in heard.steps() if one.host]) < 3 and time.monotonic() < end:
        time.sleep(0.05)
    assert {one.run for one in heard.steps()} == {told.channel.run}
    assert {name: step.state for name, step in heard.last().items()} == {
        "a": "done", "b": "done", "c": "failed", "d": "waiting",
    }  # fmt: skip
    assert {(one.step, one.state) for one in heard.steps() if one.host} >= {
        ("a", "done"),
        ("b", "done"),
        ("c", "failed"),
    }


def test_kafka_gets_a_run(run: Run, broker: Broker) -> None:
    run(broker.servers)
    heard = Heard()
    end = time.monotonic() + 30
    for body in kafka.read(broker.servers, event_publishers.TOPIC, group="test", from_start=True, wait=0.2):
        if body is not None:
            heard.events.append(Event.model_validate_json(body))
        if time.monotonic() > end or (heard.runs() and heard.runs()[-1].state == "done"):
            break
    assert {name: step.state for name, step in heard.last().items()} == dict.fromkeys("abcd", "done")


def test_what_no_broker_took_is_sent_by_the_next_run(run: Run, broker: Broker, tmp_path: Path) -> None:
    broker.kill()
    began = time.monotonic()
    run(broker.servers)
    assert time.monotonic() - began < 30
    broker.start()
    run(broker.servers)
    heard = Heard()
    end = time.monotonic() + 30
    for body in kafka.read(broker.servers, event_publishers.TOPIC, group="test", from_start=True, wait=0.2):
        if body is not None:
            heard.events.append(Event.model_validate_json(body))
        if time.monotonic() > end or {one.kept for one in heard.runs() if one.state == "done"} == {0, 4}:
            break
    assert len({one.run for one in heard.steps()}) == 2
    assert {one.state for one in heard.steps() if one.step == "a"} >= {"done", "kept"}


def test_a_bus_that_breaks_breaks_no_run(
    run: Run, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(*_: object) -> list[Any]:
        raise OSError("the disk is gone")

    monkeypatch.setattr(event_publishers, "opened", broken)
    run(NOBODY)
    assert "the bus isn't told of this run any more: OSError: the disk is gone" in caplog.text


@pytest.mark.parametrize("where", ["", "a b", "localhost:9092,", "localhost:9092;other:1", "ros2,", "http://a:1"])
def test_what_is_no_bus_is_refused_before_anything_runs(where: str) -> None:
    with pytest.raises(SettingError, match="--bus: must be HOST:PORT"), published(where, "run", "toys"):
        raise AssertionError("it ran")
