"""Real Prefect servers, databases and workers in processes of their own, stopped after the tests."""

from __future__ import annotations

import fcntl
import json
import os
import shlex
import shutil
import signal
import socket
import sqlite3
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any

import pytest
from _pytest.mark import ParameterSet

from tests.conftest import ROOT
from tests.fakes.ports import free_port
from tests.flows.prefect.toy_steps import TOYS
from tests.flows.processes import processes
from tests.waiting import until

pytest.importorskip("prefect")

QUIET = {
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "PREFECT_SERVER_UI_ENABLED": "false",
    "PREFECT_CLI_PROMPT": "false",
    "PREFECT_CLI_COLORS": "false",
    "PREFECT_CLI_WRAP_LINES": "false",
    "DO_NOT_TRACK": "1",
    "PYTHONUTF8": "1",  # its command prints characters that other encodings can't represent
    # by default, runs of a new schedule are created once per minute, except for new deployments
    "PREFECT_SERVER_SERVICES_SCHEDULER_LOOP_SECONDS": "2",
    "PREFECT_SERVER_SERVICES_SCHEDULER_MAX_RUNS": "5",  # of a schedule; by default, a hundred are created
    # what no test looks at: logs, late, paused and cancelling runs, states of tasks, types of blocks
    "PREFECT_LOGGING_TO_API_ENABLED": "false",
    "PREFECT_SERVER_SERVICES_LATE_RUNS_ENABLED": "false",
    "PREFECT_SERVER_SERVICES_PAUSE_EXPIRATIONS_ENABLED": "false",
    "PREFECT_SERVER_SERVICES_CANCELLATION_CLEANUP_ENABLED": "false",
    "PREFECT_SERVER_SERVICES_TASK_RUN_RECORDER_ENABLED": "false",
    "PREFECT_SERVER_REGISTER_BLOCKS_ON_START": "false",
    "RAY_USAGE_STATS_ENABLED": "0",
}
COMMANDS = """
import json, runpy, sys
for command in json.loads(sys.argv[1]):
    sys.argv = ["prefect", *command]
    try:
        runpy.run_module("prefect", run_name="__main__")
    except SystemExit as ended:
        if ended.code:
            raise
"""
"""Script that runs several commands of `prefect`, which takes seconds to import, until one fails."""
DATABASE = "prefect.db"
"""Name of Prefect's SQLite database in its home folder."""
API_PAUSE_S = 0.5
"""Longest pause between two calls of the API that wait for a state; each call keeps the server busy for a moment."""
ENDED = ("COMPLETED", "FAILED", "CRASHED", "CANCELLED")


def environment(home: Path) -> dict[str, str]:
    """This environment with test settings of Prefect only, without a configured server."""
    ours = {k: v for k, v in os.environ.items() if not k.startswith("PREFECT_")}
    return ours | QUIET | {"PREFECT_HOME": str(home)}


def kill(process: subprocess.Popen[Any]) -> None:
    """Kill a process that was started in a session of its own, and its children."""
    try:
        os.killpg(process.pid, signal.SIGKILL)
    except ProcessLookupError:
        pass
    process.wait()


class Server:
    """A Prefect server on a free port.

    Args:
        home: folder of its settings, logs and SQLite database.
        database: URL of another database.
    """

    def __init__(self, home: Path, database: str | None = None) -> None:
        self.home, self.port = home, free_port()
        self.url = f"http://127.0.0.1:{self.port}/api"
        self.env = environment(home) | {"PREFECT_API_URL": self.url, TOYS: "1"}
        self.env["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
        if database:
            self.env["PREFECT_SERVER_DATABASE_CONNECTION_URL"] = database
        self._process: subprocess.Popen[Any] | None = None

    def start(self) -> None:
        """Start the server (again)."""
        with open(self.home / "server.log", "a", encoding="utf-8") as log:
            command = [sys.executable, "-m", "prefect", "server", "start", "--port", str(self.port)]
            self._process = subprocess.Popen(
                command, env=self.env, cwd=self.home, stdout=log, stderr=log, start_new_session=True
            )
        try:
            until(self._healthy, 120, what="server")
        except TimeoutError:
            self.kill()
            raise RuntimeError((self.home / "server.log").read_text(encoding="utf-8")[-3000:]) from None

    def kill(self) -> None:
        """Kill the server."""
        if self._process:
            kill(self._process)

    def close(self) -> None:
        """Kill the server and all processes that use its folder."""
        self.kill()
        for process in processes("PREFECT_HOME", str(self.home)):
            try:
                os.kill(process, signal.SIGKILL)
            except ProcessLookupError:
                continue

    def _healthy(self) -> bool:
        try:
            return bool(self.api("GET", "/health"))
        except OSError:
            return False

    def api(self, method: str, path: str, body: Any = None) -> Any:
        """Call Prefect's REST API."""
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(self.url + path, data, {"Content-Type": "application/json"}, method=method)
        for _ in range(10):
            try:
                with urllib.request.urlopen(request, timeout=30) as answer:
                    text = answer.read()
                return json.loads(text) if text else None
            except urllib.error.HTTPError as error:
                if error.code != 503:
                    raise
                time.sleep(1)  # the SQLite database is locked
            except TimeoutError:
                if method != "GET":
                    raise
        raise TimeoutError(f"{path}: the database stays locked")

    def cli(self, *commands: str, **env: str) -> subprocess.CompletedProcess[str]:
        """Run `prefect COMMAND` for each of the commands in the repository, until one fails."""
        split = [shlex.split(command) for command in commands]
        return self.script(sys.executable, "-c", COMMANDS, json.dumps(split), **env)

    def script(self, *command: str, **env: str) -> subprocess.CompletedProcess[str]:
        """Run a command in the repository."""
        return subprocess.run(
            command, env=self.env | env, cwd=ROOT, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )  # fmt: skip

    def spawn(self, *args: str, log: Path, **env: str) -> subprocess.Popen[Any]:
        """Start `python ARGS` in the repository, in a session of its own."""
        with open(log, "w", encoding="utf-8") as file:
            return subprocess.Popen(
                [sys.executable, *args], env=self.env | env, cwd=ROOT, stdout=file, stderr=file, start_new_session=True
            )

    @contextmanager
    def worker(self, pool: str) -> Iterator[subprocess.Popen[Any]]:
        """A worker that polls a process pool."""
        process = self.spawn(
            "-m", "prefect", "worker", "start", "--pool", pool, "--no-create-pool-if-not-found",
            log=self.home / f"{pool}.log", PREFECT_WORKER_QUERY_SECONDS="1", PREFECT_WORKER_HEARTBEAT_SECONDS="5",
        )  # fmt: skip
        try:
            yield process
        finally:
            kill(process)

    def deployment(self, flow: str, name: str) -> dict[str, Any]:
        """A deployment from the server."""
        return self.api("GET", f"/deployments/name/{flow}/{name}")

    def run(self, deployment: dict[str, Any], **parameters: Any) -> str:
        """Start a run of a deployment; returns its id."""
        made = self.api("POST", f"/deployments/{deployment['id']}/create_flow_run", {"parameters": parameters})
        return made["id"]

    def runs(self, deployment: dict[str, Any], state: str) -> list[dict[str, Any]]:
        """All runs of a deployment in this state."""
        runs = self.api("POST", "/flow_runs/filter", {"deployments": {"id": {"any_": [deployment["id"]]}}})
        return [run for run in runs if run["state_type"] == state]

    @contextmanager
    def scheduled(self, deployment: dict[str, Any], parameters: dict[str, Any], **when: Any) -> Iterator[None]:
        """Add a schedule to a deployment while the context is active."""
        path = f"/deployments/{deployment['id']}/schedules"
        made = self.api(
            "POST", path, [{"schedule": when, "active": True, "max_scheduled_runs": 5, "parameters": parameters}]
        )
        try:
            yield
        finally:
            self.api("DELETE", f"{path}/{made[0]['id']}")

    def heartbeats(self, run: str) -> list[dict[str, Any]]:
        """Heartbeats of a run."""
        names = {"event": {"name": ["prefect.flow-run.heartbeat"]}}
        body = {"filter": names | {"resource": {"id": [f"prefect.flow-run.{run}"]}}}
        return self.api("POST", "/events/filter", body)["events"]

    def ended(self, run: str, seconds: float = 200) -> dict[str, Any]:
        """Wait for the end of a run; returns its state."""

        def state() -> dict[str, Any] | None:
            now = self.api("GET", f"/flow_runs/{run}")["state"]
            return now if now["type"] in ENDED else None

        return until(state, seconds, what=f"run {run}", max_pause=API_PAUSE_S)


@contextmanager
def postgres() -> Iterator[str]:
    """A temporary PostgreSQL server; yields its URL for Prefect."""
    debian = sorted(map(str, Path("/usr/lib/postgresql").glob("*/bin")), reverse=True)  # not on the PATH in Debian
    path = os.pathsep.join([*debian, os.environ.get("PATH", "")])
    initdb, serve = shutil.which("initdb", path=path), shutil.which("postgres", path=path)
    if not initdb or not serve:
        pytest.skip("PostgreSQL isn't installed (tests/flows/prefect/packages.txt)")
    # PostgreSQL refuses to run as root
    drop = ["setpriv", "--reuid", "nobody", "--regid", "nogroup", "--clear-groups"] if os.getuid() == 0 else []
    data = Path(tempfile.mkdtemp(prefix="scan2sim-postgres-"))
    try:
        if drop:
            shutil.chown(data, "nobody", "nogroup")
        subprocess.run(
            [*drop, initdb, "-D", data / "db", "-U", "prefect", "-A", "trust", "--no-sync"],
            check=True, stdout=subprocess.DEVNULL, cwd=data,
        )  # fmt: skip
        port = free_port()
        with open(data.with_suffix(".log"), "w", encoding="utf-8") as log:
            process = subprocess.Popen(
                [*drop, serve, "-D", data / "db", "-k", data, "-h", "127.0.0.1", "-p", str(port), "-F"],
                stdout=log, stderr=log, cwd=data, start_new_session=True,
            )  # fmt: skip
        try:
            until(lambda: _listens(port), what="PostgreSQL")
            yield f"postgresql+asyncpg://prefect@127.0.0.1:{port}/postgres"
        finally:
            kill(process)
    finally:
        shutil.rmtree(data, ignore_errors=True)
        data.with_suffix(".log").unlink(missing_ok=True)


def _listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


class NewDatabase:
    """Copy of the SQLite database that the first server creates, for later ones: to create one takes ten seconds."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def copy_to(self, home: Path) -> bool:
        """Copy it to the folder of a server that starts; returns whether there is one yet."""
        if made := self._path.exists():
            shutil.copyfile(self._path, home / DATABASE)
        return made

    def start(self, server: Server) -> None:
        """Start a server with it; if several start at once without one, the first creates it."""
        with open(self._path.with_suffix(".lock"), "w", encoding="utf-8") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not self.copy_to(server.home):
                server.start()
                part = self._path.with_suffix(".part")
                with closing(sqlite3.connect(server.home / DATABASE)) as made, closing(sqlite3.connect(part)) as copy:
                    made.backup(copy)
                part.rename(self._path)
                return
        server.start()


@pytest.fixture(scope="session")
def new_database(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> NewDatabase:
    """The database of a new server, which all workers of a parallel run share."""
    own = tmp_path_factory.getbasetemp()
    return NewDatabase((own.parent if hasattr(request.config, "workerinput") else own) / "prefect_new.db")


@contextmanager
def serving(database: str, home: Path, new_database: NewDatabase) -> Iterator[Server]:
    """A running Prefect server with a database: "sqlite" or "postgres"."""
    with ExitStack() as stack:
        server = Server(home, stack.enter_context(postgres()) if database == "postgres" else None)
        stack.callback(server.close)
        if database == "sqlite":
            new_database.start(server)
        else:
            server.start()
        yield server


@pytest.fixture(scope="module")
def server(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, new_database: NewDatabase
) -> Iterator[Server]:
    """A running server with the database selected by `on`, until the last test of the file that uses it.

    pytest groups the tests of a file by database, so that one server runs at a time.
    """
    with serving(request.param, tmp_path_factory.mktemp(request.param), new_database) as server:
        yield server


def on(*databases: str | ParameterSet) -> pytest.MarkDecorator:
    """Mark a test to run with these databases."""
    return pytest.mark.parametrize("server", databases, indirect=True, scope="module")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Folder of a toy survey."""
    (tmp_path / "source.txt").write_text("1", encoding="utf-8")
    return tmp_path
