"""Progress of runs on the event bus: published states; runs neither wait for the bus nor fail because of it."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from scan2sim.flows.commands.log import Log
from scan2sim.flows.commands.run_with_progress import execute_with_progress
from scan2sim.flows.engine.dispatch import dispatch
from scan2sim.flows.engine.execution import run_on_worker
from scan2sim.flows.engine.planning import PlannedTask, plan
from scan2sim.flows.engine.progress import (
    CLOSE_TIMEOUT_S,
    HEARTBEAT_INTERVAL_S,
    PUBLISH_INTERVAL_S,
    Publisher,
    published,
)
from scan2sim.flows.engine.versions import versions
from scan2sim.pipeline.core.cache import Store
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.services.monitoring.events import event_publishers
from scan2sim.services.monitoring.events.schema import Event, Outlet, RunState, StepState
from tests.fakes.broker import Broker
from tests.flows.bus_events import read_events
from tests.flows.toy import chain
from tests.waiting import until

NO_BROKER = "127.0.0.1:9"


class RecordingOutlet:
    """An outlet that records the events."""

    def __init__(self, events: list[Event] | None = None) -> None:
        self.events = events or []

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
        publisher = None
        try:
            with published(where, "run", "toys") as publisher:
                log = Log(tmp_path / "run.log")
                execute_with_progress(planned, store, log, 2, keep_going=True, bus=publisher).check()
        finally:
            if publisher:
                publisher.steps.close(60)  # the end of a run waits for its last events only for a moment

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


class VirtualTime:
    """Time of a publisher that passes while it waits, in steps of a millisecond.

    Args:
        end_s: end of the run.
        each: called after each millisecond with the time in seconds.
        stall: seconds by which the wait at some time, rounded to seconds, is too long.
    """

    def __init__(self, end_s: float, each: Callable[[float], None], stall: dict[int, int]) -> None:
        self._ms, self._end_ms, self._each, self._stall = 0, round(1000 * end_s), each, stall

    def clock(self) -> float:
        return self._ms / 1000

    def wait(self, ended: threading.Event, seconds: float) -> bool:
        seconds += self._stall.get(self._ms // 1000, 0)
        for _ in range(min(round(1000 * seconds), self._end_ms - self._ms)):
            self._ms += 1
            self._each(self.clock())
        return self._ms >= self._end_ms


OnEvent = Callable[[str, float, str], None]


def published_in_virtual_time(
    end_s: float, each: Callable[[OnEvent, float], None] = lambda *_: None, stall: dict[int, int] | None = None
) -> RecordingOutlet:
    """What a run of the tasks a and b publishes within `end_s` seconds; a starts at once."""
    outlet, tracked = RecordingOutlet(), threading.Event()
    time = VirtualTime(end_s, lambda now: each(of_a, now), stall or {})

    def open_outlets() -> list[Outlet]:
        tracked.wait()
        return [outlet]

    def about(steps: Counter[Any], ended: bool) -> RunState:
        return RunState(
            run="1", command="run", source="toys", host="here", state="done" if ended else "running",
            steps=steps.total(), running=0, done=0, cached=0, failed=0, seconds=time.clock(), message="",
        )  # fmt: skip

    publisher = Publisher("1", open_outlets, about, clock=time.clock, wait=time.wait)
    source, nowhere = Path(__file__), Store(Path("nowhere"))
    planned = plan(chain(source, source)[:2], nowhere)
    on_event = publisher.track(planned, nowhere)

    def of_a(event: Any, fraction: float, message: str) -> None:
        on_event(planned[0].task, event, fraction, message)

    of_a("start", 0.0, "")
    tracked.set()
    publisher.close(60)
    return outlet


def test_progress_is_published_at_a_limited_rate() -> None:
    def each(of_a: OnEvent, now: float) -> None:
        of_a("progress", now / 5, "at\x1b[31m it " + 500 * "x")

    outlet = published_in_virtual_time(5.5 * PUBLISH_INTERVAL_S, each)
    steps = [one for one in outlet.steps() if one.step == "a"]
    assert [one.progress for one in steps] == [0.2, 0.4, 0.6, 0.8, 1.0, 1.0], "although there were 5500 events"
    assert [one.seconds for one in outlet.runs()] == [1, 2, 3, 4, 5, 5.5]
    assert len(steps[-1].message) == 400 and "\x1b" not in steps[-1].message


def test_running_steps_are_published_again_as_heartbeat() -> None:
    outlet = published_in_virtual_time(1 + 4 * HEARTBEAT_INTERVAL_S)
    assert [one.seconds for one in outlet.steps() if one.step == "a"] == [1, 6, 11, 16, 21]
    assert [one.step for one in outlet.steps()].count("b") == 1, "it doesn't run"
    assert [(one.seconds, one.state) for one in outlet.runs()] == [
        (1, "running"), (6, "running"), (11, "running"), (16, "running"), (21, "done"),
    ]  # fmt: skip


def test_stalled_publisher_continues_with_the_latest_state() -> None:
    outlet = published_in_virtual_time(30, lambda of_a, now: of_a("progress", now / 30, ""), {3: 20})
    times = [1, 2, 3, *range(24, 31)]
    assert [one.seconds for one in outlet.steps() if one.step == "a"] == times
    assert [one.seconds for one in outlet.runs()] == times


def test_run_does_not_wait_for_a_bus_that_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    opened, recording = threading.Event(), RecordingOutlet()

    def blocks(_: str) -> list[Outlet]:
        opened.wait()
        return [recording]

    monkeypatch.setattr(event_publishers, "open_outlets", blocks)
    with published(NO_BROKER, "run", "toys") as publisher:
        pass
    assert publisher and not recording.events and CLOSE_TIMEOUT_S < 5
    opened.set()
    publisher.steps.close(60)
    assert [one.state for one in recording.runs()] == ["done"]


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
    by_workers = {("a", "done"), ("b", "done"), ("c", "failed")}
    last = {"a": "done", "b": "done", "c": "failed", "d": "waiting"}
    until(
        lambda: (
            {(one.step, one.state) for one in outlet.steps() if one.host} >= by_workers
            and {name: step.state for name, step in outlet.last().items()} == last
        ),
        what="the events of all workers",
        state=lambda: outlet.events,
    )
    assert {one.run for one in outlet.steps()} == {publisher.channel.run}


def test_run_is_published_to_kafka(run: Run, broker: Broker) -> None:
    run(broker.servers)
    outlet = RecordingOutlet(
        read_events(broker, lambda events: [one.state for one in RecordingOutlet(events).runs()][-1:] == ["done"])
    )
    assert {name: step.state for name, step in outlet.last().items()} == dict.fromkeys("abcd", "done")


def test_unsent_events_are_sent_by_the_next_run(run: Run, broker: Broker) -> None:
    broker.kill()
    run(broker.servers)
    broker.start()
    run(broker.servers)

    def both_have_ended(events: list[Event]) -> bool:
        return {one.cached for one in RecordingOutlet(events).runs() if one.state == "done"} == {0, 4}

    outlet = RecordingOutlet(read_events(broker, both_have_ended))
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
