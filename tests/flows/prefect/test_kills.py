"""Surveys on a cluster whose workers, flow or server are killed: they finish, and finished steps don't run twice.

Also what flows and workers publish on the event bus: one server serves all tests of this file.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import urllib.request
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from http.client import HTTPException
from pathlib import Path
from typing import Any

import psutil
import pytest

from scan2sim.flows.engine.dispatch import dispatch
from scan2sim.flows.engine.planning import PlannedTask
from scan2sim.flows.engine.run_task import run_task
from scan2sim.flows.pipelines.graph import TaskId
from scan2sim.pipeline.core.cache import Store
from scan2sim.services.monitoring.dashboard.state import BusState
from scan2sim.services.monitoring.events.schema import Event
from tests.conftest import ROOT
from tests.fakes.broker import Broker
from tests.flows.bus_events import read_events
from tests.flows.prefect.conftest import NewDatabase, Server, environment, kill, on
from tests.flows.prefect.toy_steps import STEPS, planned
from tests.flows.processes import processes
from tests.waiting import until

SCRIPT = "from tests.flows.prefect.toy_flow import main; main()"
TILES = 3
ALL = {f"{tile}-{step}" for tile in range(TILES) for step in STEPS}


class Survey:
    """The toy survey of `toy_flow.main`, run as a script; its last steps wait until `gate` exists."""

    def __init__(self, server: Server, folder: Path, runner: str) -> None:
        self.folder, self._server, self._runner, self.gate = folder, server, runner, folder / "gate"
        self._outputs: list[Path] = []

    def start(self) -> subprocess.Popen[bytes]:
        """Start the script (again), in a process group of its own."""
        (self.folder / "started").unlink(missing_ok=True)  # steps that an earlier process has lost aren't running
        self._outputs.append(self.folder / f"output{len(self._outputs)}")
        arguments = ("-c", SCRIPT, str(self.folder), str(TILES), self._runner, str(self.gate))
        return self._server.spawn(*arguments, log=self._outputs[-1], SURVEY=str(self.folder))

    def processes(self) -> list[int]:
        """Ids of its processes and their descendants."""
        return processes("SURVEY", str(self.folder))

    def wait_until_running(self) -> dict[str, int]:
        """Wait until some steps are done and both workers run last steps, which wait; returns these."""

        def waiting() -> dict[str, int] | None:
            running = self.running_steps()
            return running if len(running) == 2 and all(name.endswith(STEPS[-1]) for name in running) else None

        try:
            return until(waiting, 200, what="two last steps", max_pause=0.5)
        except TimeoutError as error:
            raise AssertionError(f"{error}; {len(self.done())} are done\n{self.output()}") from None

    def planned(self) -> list[PlannedTask]:
        """Its tasks, with the reasons why they run."""
        return planned(self.folder, TILES, self.gate)

    def done(self) -> dict[str, int]:
        """Time in ns when each step with a cached result was finished."""
        store = Store(self.folder / "steps")
        kept = [p for p in self.planned() if store.find(p.task.full_name, p.key)]
        return {
            p.task.full_name: (store.folder(p.task.full_name, p.key) / "manifest.json").stat().st_mtime_ns for p in kept
        }

    def running_steps(self) -> dict[str, int]:
        """Running steps and the process ids of their workers."""
        if not (self.folder / "started").exists():
            return {}
        begun = dict(line.split()[::2] for line in (self.folder / "started").read_text(encoding="utf-8").splitlines())
        ended = {label.replace("/", "-") for label in self.done()}
        return {name: int(worker) for name, worker in begun.items() if name not in ended}

    def runs(self) -> Counter[str]:
        """Number of times that each step has finished."""
        return Counter((self.folder / "log").read_text(encoding="utf-8").split())

    def finish(self, process: subprocess.Popen[bytes]) -> str:
        """Let the last steps run, and wait for the end of the process; returns its output."""
        self.gate.touch()
        process.wait()
        return self.output()

    def output(self) -> str:
        """Output since the last start."""
        return self._outputs[-1].read_text(encoding="utf-8")


@pytest.fixture
def survey(request: pytest.FixtureRequest, server: Server, folder: Path) -> Survey:
    """A survey on Dask, unless the test sets another runner."""
    return Survey(server, folder, getattr(request, "param", "dask"))


@on("sqlite")
@pytest.mark.parametrize("survey", ["dask", pytest.param("ray", marks=pytest.mark.slow)], indirect=True)
def test_survey_finishes_after_a_worker_is_killed(survey: Survey) -> None:
    process = survey.start()
    lost = survey.wait_until_running()
    os.kill(next(iter(lost.values())), signal.SIGKILL)
    output = survey.finish(process)
    assert f"total {TILES * 4}" in output, output[-3000:]
    assert set(survey.runs()) == ALL
    assert {name for name, count in survey.runs().items() if count > 1} <= set(lost)


@on("sqlite")
@pytest.mark.parametrize("survey", ["dask", pytest.param("ray", marks=pytest.mark.slow)], indirect=True)
def test_survey_resumes_after_its_flow_and_the_server_are_killed(survey: Survey, server: Server) -> None:
    process = survey.start()
    survey.wait_until_running()
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    until(lambda: not survey.processes(), what="the end of all its processes")
    before = survey.done()
    assert 4 <= len(before) < len(ALL)

    process = survey.start()
    survey.wait_until_running()
    assert before.items() <= survey.done().items()
    server.kill()
    before = survey.done()
    server.start()
    survey.finish(process)  # may succeed or fail

    output = survey.finish(survey.start())
    assert f"total {TILES * 4}" in output, output[-3000:]
    assert before.items() <= survey.done().items()
    assert survey.runs() == Counter(ALL)
    assert all(item.reason is None for item in survey.planned())


@on("sqlite")
@pytest.mark.parametrize("runner", ["dask", pytest.param("threads", marks=pytest.mark.slow)])
def test_flow_and_workers_publish_the_same_run(
    runner: str, server: Server, folder: Path, broker: Broker, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(folder / "state"))
    (folder / "gate").touch()
    tiles = 2
    arguments = ("-c", SCRIPT, str(folder), str(tiles), runner, str(folder / "gate"), broker.servers)
    process = server.spawn(*arguments, log=folder / "output", XDG_STATE_HOME=str(folder / "state"))
    assert process.wait() == 0, (folder / "output").read_text(encoding="utf-8")

    def hosts(events: list[Event]) -> set[tuple[str, str]]:
        done = [event.body for event in events if event.kind == "step" and event.body["state"] == "done"]
        return {(body["tile"], body["step"]) for body in done if body["host"]}

    def complete(events: list[Event]) -> bool:
        ended = any(event.kind == "run" and event.body["state"] != "running" for event in events)
        return ended and len(hosts(events)) == tiles * len(STEPS)

    bus_state = BusState(time.time())
    for event in (events := read_events(broker, complete)):
        bus_state.add(event.model_dump_json().encode())
    (run,) = bus_state.state(time.time())["runs"]
    last = run["details"]["last"]
    assert (last["command"], last["source"], last["state"]) == ("survey", str(folder), "done")
    assert last["done"] == last["steps"] == len(hosts(events)) == tiles * len(STEPS)
    assert all(step["state"] == "done" and step["seconds"] and step["memory"] for step in run["details"]["steps"])
    assert not bus_state.rejections.counts


@pytest.fixture
def one_tile(tmp_path: Path) -> Path:
    """A survey of one tile, which needn't be cut first."""
    folder = tmp_path / "survey"
    folder.mkdir()
    text = f'name = "street"\ncrs = "EPSG:32633"\nlength = 100\nbuffer = 5\ntiles = ["{ROOT}/data_samples/tile"]\n'
    (folder / "survey.toml").write_text(text, encoding="utf-8")
    return folder


def test_ctrl_c_stops_the_run_and_its_temporary_server(
    tmp_path: Path, one_tile: Path, new_database: NewDatabase
) -> None:
    """The terminal also interrupts the server, so Prefect can't be notified."""
    new_database.copy_to(tmp_path)
    out, log = tmp_path / "out", tmp_path / "log"
    command = [sys.executable, "-m", "scan2sim.flows.cli", "survey", str(one_tile), "--out", str(out)]
    command += ["--runner", "dask", "--jobs", "1"]
    with open(log, "w", encoding="utf-8") as file:
        process = subprocess.Popen(
            command, env=environment(tmp_path), cwd=ROOT, stdout=file, stderr=file, start_new_session=True
        )
    try:
        until(lambda: list(out.glob("steps/*/*/*/manifest.json")), 250, what="a finished step")
        os.killpg(process.pid, signal.SIGINT)
        assert process.wait() == 130
        until(lambda: not processes("PREFECT_HOME", str(tmp_path)), what="the end of all its processes")
    finally:
        kill(process)
    assert "the same command resumes from there" in log.read_text(encoding="utf-8")


def test_temporary_server_ends_with_a_killed_command(tmp_path: Path, one_tile: Path, new_database: NewDatabase) -> None:
    new_database.copy_to(tmp_path)
    out, log = tmp_path / "out", tmp_path / "log"
    command = [sys.executable, "-m", "scan2sim.flows.cli", "survey", str(one_tile), "--out", str(out)]
    with open(log, "w", encoding="utf-8") as file:
        process = subprocess.Popen(
            [*command, "--runner", "threads"], env=environment(tmp_path), cwd=ROOT, stdout=file, stderr=file,
            start_new_session=True,
        )  # fmt: skip
    try:
        server = until(lambda: temporary_servers(tmp_path), 250, what="its server")
        until(lambda: list(out.glob("steps/*/*/*/manifest.json")), 250, what="a finished step")
        process.kill()  # only the command
        until(lambda: not processes("PREFECT_HOME", str(tmp_path)), what="the end of all its processes")
    finally:
        kill(process)
    assert not any(answers(port) for port in server)


def test_temporary_server_ends_with_its_context(tmp_path: Path) -> None:
    """Even if the command fails; and another one may be started afterwards. The first one creates the database."""
    script = (
        "from scan2sim.flows.deployed.prefect_server import prefect_server\n"  # sets its start-up timeout
        "from prefect.settings import PREFECT_API_URL\n"
        "from tests.flows.prefect.test_kills import answers\n"
        "for _ in range(2):\n"
        "    try:\n"
        "        with prefect_server():\n"
        "            port = int(PREFECT_API_URL.value().split(':')[-1].split('/')[0])\n"
        "            assert answers(port)\n"
        "            raise KeyError\n"
        "    except KeyError:\n"
        "        assert not answers(port) and PREFECT_API_URL.value() is None\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], env=environment(tmp_path), cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


def temporary_servers(home: Path) -> list[int]:
    """Ports of the Prefect servers in the processes that use this folder."""
    ports = []
    for process in processes("PREFECT_HOME", str(home)):
        with suppress(psutil.Error):
            sockets = psutil.Process(process).net_connections("tcp")
            ports += [one.laddr.port for one in sockets if one.status == psutil.CONN_LISTEN]
    return [port for port in ports if answers(port)]


def answers(port: int) -> bool:
    """Whether a Prefect server answers on this port."""
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/api/health", timeout=60) as answer:
            return bool(answer.status == 200)
    except (OSError, HTTPException):
        return False


class FailedFuture:
    """A failed future of a runner that lost too many workers to a step (Dask: `KilledWorker`)."""

    def add_done_callback(self, fn: Callable[[Any], None]) -> None:
        fn(self)

    def result(self, *, raise_on_failure: bool) -> Any:
        raise RuntimeError("three workers died of it")


class FinishedFuture(FailedFuture):
    """A future of a step that has run in this process."""

    def __init__(self, item: PlannedTask, store: Store) -> None:
        run_task(item, store, item.inputs(store))

    def result(self, *, raise_on_failure: bool) -> Any:
        return "its manifest's path"


def test_step_that_crashes_its_workers_fails_alone(folder: Path) -> None:
    store, second = Store(folder / "steps"), TaskId("second", tile="0")

    def submit(item: PlannedTask) -> FailedFuture:
        return FailedFuture() if item.task.id == second else FinishedFuture(item, store)

    outcome = dispatch(planned(folder, 2), store, submit, 2, lambda *_: None)
    assert set(outcome.of_tile("0")) == {"first"} and set(outcome.of_tile("1")) == set(STEPS)
    assert set(outcome.failed) == {second} and "three workers died of it" in str(outcome.failed[second])
