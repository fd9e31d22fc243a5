"""Progress of runs on the event bus: published states; runs neither wait for the bus nor fail because of it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from scan2sim.flows.commands.log import Log
from scan2sim.flows.commands.run_with_progress import execute_with_progress
from scan2sim.flows.engine import progress
from scan2sim.flows.engine.dispatch import dispatch
from scan2sim.flows.engine.execution import run_on_worker
from scan2sim.flows.engine.planning import PlannedTask, plan
from scan2sim.flows.engine.progress import published
from scan2sim.flows.engine.versions import versions
from scan2sim.pipeline.core.cache import Store
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.services import kafka
from scan2sim.services.monitoring.events import event_publishers
from scan2sim.services.monitoring.events.schema import Event, RunState, StepState
from tests.fakes.broker import Broker
from tests.flows.toy import chain

NO_BROKER = "127.0.0.1:9"


class RecordingOutlet:
    """An outlet that records the events."""

    def __init__(self) -> None:
        self.events: list[Event] = []

    def send(self, event: Event) -> None:
        self.events.append(event)

    def close(self) -> None:
        pass

    def runs(self) -> list[RunState]:
        return [RunState.model_validate(one.body) for one in self.events if one.kind == "run"]

    def steps(self) -> list[StepState]:
        return [StepState.model_validate(one.body) for one in self.events if one.kind == "step"]

    def last(self) -> dict[str, StepState]:
        return {one.step: one for one in self.steps()}


@pytest.fixture
def outlet(monkeypatch: pytest.MonkeyPatch) -> RecordingOutlet:
    """Records all published events, instead of a bus."""
    recording = RecordingOutlet()
    monkeypatch.setattr(event_publishers, "open_outlets", lambda where: [recording])
    return recording


@pytest.fixture(autouse=True)
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


Run = Callable[..., None]


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Run]:
    """Run the toy graph like the commands do; keyword arguments are parameters by task."""
    source = tmp_path / "source.txt"
    source.write_text("1", encoding="utf-8")

    def go(where: str, **changes: dict[str, Any]) -> None:
        store = Store(tmp_path / "store")
        planned = plan(chain(source, tmp_path / "log", **changes), store)
        with published(where, "run", "toys") as publisher:
            execute_with_progress(planned, store, Log(tmp_path / "run.log"), 2, keep_going=True, bus=publisher).check()

    yield go


def test_run_and_steps_are_published(run: Run, outlet: RecordingOutlet) -> None:
    run(NO_BROKER)
    assert {one.run for one in outlet.steps()} == {one.run for one in outlet.runs()}
    last = outlet.last()
    assert set(last) == set("abcd")
    for step in last.values():
        assert step.state == "done" and step.progress == 1 and step.tile == "" and step.host
        assert step.seconds is not None and step.seconds < 60
        assert step.memory is not None and 10e6 < step.memory < 10e9
    ended = outlet.runs()[-1]
    assert (ended.command, ended.source, ended.state, ended.steps, ended.done) == ("run", "toys", "done", 4, 4)


def test_cached_steps_are_published_as_cached(run: Run, outlet: RecordingOutlet) -> None:
    run(NO_BROKER)
    outlet.events.clear()
    run(NO_BROKER, c={"value": 5})
    assert {name: step.state for name, step in outlet.last().items()} == {
        "a": "cached",
        "b": "cached",
        "c": "done",
        "d": "done",
    }
    assert outlet.last()["a"].seconds is None and outlet.runs()[-1].cached == 2


def test_failure_is_published_with_its_cause(run: Run, outlet: RecordingOutlet) -> None:
    with pytest.raises(Exception, match="is configured to fail"):
        run(NO_BROKER, b={"does": "fail"})
    last = outlet.last()
    assert (last["b"].state, last["b"].message) == ("failed", "is configured to fail")
    assert last["c"].state == "done" and last["d"].state == "waiting"
    ended = outlet.runs()[-1]
    assert ended.state == "failed" and "is configured to fail" in ended.message and ended.failed == 1


def test_progress_is_published_at_a_limited_rate(
    run: Run, outlet: RecordingOutlet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(progress, "PUBLISH_INTERVAL_S", 0.2)
    with published(NO_BROKER, "run", "toys") as publisher:
        assert publisher
        source = Path(__file__)
        planned = plan(chain(source, source)[:1], Store(Path("nowhere")))
        on_event, began = publisher.steps.track(planned, Store(Path("nowhere"))), time.monotonic()
        on_event(planned[0].task, "start", 0.0, "")
        while time.monotonic() < began + 1.1:
            on_event(planned[0].task, "progress", 1.5 * (time.monotonic() - began), "at\x1b[31m it " + 500 * "x")
            time.sleep(0.001)
    steps = outlet.steps()
    assert 4 <= len(steps) <= 8, "although there were about a thousand events"
    assert steps[-1].progress == 1.0 and len(steps[-1].message) == 400 and "\x1b" not in steps[-1].message


def test_running_steps_are_published_again_as_heartbeat(
    outlet: RecordingOutlet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(progress, "PUBLISH_INTERVAL_S", 0.05)
    monkeypatch.setattr(progress, "HEARTBEAT_INTERVAL_S", 0.2)
    with published(NO_BROKER, "run", "toys") as publisher:
        assert publisher
        source = Path(__file__)
        planned = plan(chain(source, source)[:2], Store(Path("nowhere")))
        publisher.steps.track(planned, Store(Path("nowhere")))(planned[0].task, "start", 0.0, "")
        time.sleep(1.0)
    names = [one.step for one in outlet.steps()]
    assert 4 <= names.count("a") <= 7 and names.count("b") == 1
    assert len(outlet.runs()) >= 4


def test_interrupted_run_is_published_as_stopped(outlet: RecordingOutlet) -> None:
    with pytest.raises(KeyboardInterrupt), published(NO_BROKER, "run", "toys"):
        raise KeyboardInterrupt
    assert [one.state for one in outlet.runs()] == ["stopped"]


def test_workers_publish_steps_of_the_same_run(tmp_path: Path, outlet: RecordingOutlet) -> None:
    source, store = tmp_path / "source.txt", Store(tmp_path / "store")
    source.write_text("1", encoding="utf-8")
    planned = plan(chain(source, tmp_path / "log", c={"does": "fail"}), store)

    class PoolFuture:
        def __init__(self, pool: ThreadPoolExecutor, *arguments: Any) -> None:
            self._future = pool.submit(run_on_worker, *arguments)

        def add_done_callback(self, fn: Callable[[Any], None]) -> None:
            self._future.add_done_callback(fn)

        def result(self, *, raise_on_failure: bool) -> Any:
            return self._future.exception() or self._future.result()

    with ThreadPoolExecutor(2) as pool, published(NO_BROKER, "survey", "toys", local=False) as publisher:
        assert publisher
        channel, on_event = publisher.channel, publisher.steps.track(planned, store)

        def submit(item: PlannedTask) -> PoolFuture:
            return PoolFuture(pool, item, store, None, None, versions(), channel)

        dispatch(planned, store, submit, 2, lambda *_: None, on_event)
    end = time.monotonic() + 10
    while len([one for one in outlet.steps() if one.host]) < 3 and time.monotonic() < end:
        time.sleep(0.05)
    assert {one.run for one in outlet.steps()} == {publisher.channel.run}
    assert {name: step.state for name, step in outlet.last().items()} == {
        "a": "done", "b": "done", "c": "failed", "d": "waiting",
    }  # fmt: skip
    assert {(one.step, one.state) for one in outlet.steps() if one.host} >= {
        ("a", "done"),
        ("b", "done"),
        ("c", "failed"),
    }


def test_run_is_published_to_kafka(run: Run, broker: Broker) -> None:
    run(broker.servers)
    outlet = RecordingOutlet()
    end = time.monotonic() + 30
    for body in kafka.read(broker.cluster, event_publishers.TOPIC, group="test", from_start=True, wait=0.2):
        if body is not None:
            outlet.events.append(Event.model_validate_json(body))
        if time.monotonic() > end or (outlet.runs() and outlet.runs()[-1].state == "done"):
            break
    assert {name: step.state for name, step in outlet.last().items()} == dict.fromkeys("abcd", "done")


def test_unsent_events_are_sent_by_the_next_run(run: Run, broker: Broker, tmp_path: Path) -> None:
    broker.kill()
    began = time.monotonic()
    run(broker.servers)
    assert time.monotonic() - began < 30
    broker.start()
    run(broker.servers)
    outlet = RecordingOutlet()
    end = time.monotonic() + 30
    for body in kafka.read(broker.cluster, event_publishers.TOPIC, group="test", from_start=True, wait=0.2):
        if body is not None:
            outlet.events.append(Event.model_validate_json(body))
        if time.monotonic() > end or {one.cached for one in outlet.runs() if one.state == "done"} == {0, 4}:
            break
    assert len({one.run for one in outlet.steps()}) == 2
    assert {one.state for one in outlet.steps() if one.step == "a"} >= {"done", "cached"}


def test_failing_bus_does_not_fail_the_run(
    run: Run, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(*_: object) -> list[Any]:
        raise OSError("the disk is gone")

    monkeypatch.setattr(event_publishers, "open_outlets", broken)
    run(NO_BROKER)
    assert "progress is no longer published: OSError: the disk is gone" in caplog.text


@pytest.mark.parametrize("where", ["", "a b", "localhost:9092,", "localhost:9092;other:1", "ros2,", "http://a:1"])
def test_invalid_bus_is_rejected_before_the_run(where: str) -> None:
    with pytest.raises(SettingError, match="--bus: must be HOST:PORT"), published(where, "run", "toys"):
        raise AssertionError("it ran")
