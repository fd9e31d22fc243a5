"""Worker processes: scaling, retries of events, cleanup when the parent is killed."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil

from scan2sim.services.monitoring.autoscale.actuators import supervise
from scan2sim.services.monitoring.autoscale.actuators.replicas import ProgramReplicas
from scan2sim.services.monitoring.example_nodes import worker
from scan2sim.services.monitoring.work.local_workers import LocalWorkers
from scan2sim.services.monitoring.work.queue import EventQueue
from tests.conftest import ROOT
from tests.waiting import until

WORKER = worker.command(0.05)


def running(command: list[str]) -> list[psutil.Process]:
    """Descendants of this process that run a command."""
    found = []
    for process in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.Error):  # it has ended
            found += [process] * (process.cmdline() == command)
    return found


def test_workers_scale_and_process_all_events() -> None:
    queue = EventQueue("events")
    pool = LocalWorkers(queue, WORKER)
    for number in range(60):
        assert queue.put(str(number), time.time())
    pool.scale(3)
    until(lambda: pool.workers() == 3 and len(running(WORKER)) == 3)
    pool.scale(1)
    until(lambda: len(running(WORKER)) == 1)
    until(lambda: len(queue) == 0)
    state = queue.state(1.0, pool.workers())
    assert (state.arrived, state.done, state.rejected, state.workers) == (60, 60, 0, 1)
    pool.close()
    assert running(WORKER) == []


def test_killed_worker_is_replaced_and_its_event_retried(tmp_path: Path) -> None:
    queue, taken = EventQueue("events"), tmp_path / "taken"
    # the first worker hangs at its first event, the next one replies
    program = f'read -r line; if [ -e "{taken}" ]; then echo done; else echo "$line" > "{taken}"; fi; read -r line'
    command = ["sh", "-c", program]
    pool = LocalWorkers(queue, command)
    pool.scale(1)
    queue.put("a", time.time())
    until(taken.exists)
    assert queue.state(1.0, 0).waiting == 1
    running(command)[0].kill()
    until(lambda: len(queue) == 0)
    state = queue.state(1.0, 0)
    assert (state.done, state.rejected) == (1, 0)
    pool.close()


def test_hanging_worker_is_killed_and_its_event_dropped_after_retries() -> None:
    queue = EventQueue("events")
    hanging = worker.command(1000.0)
    pool = LocalWorkers(queue, hanging, deadline=0.2)
    queue.put("hangs", time.time())
    pool.scale(1)
    until(lambda: len(queue) == 0)
    assert queue.state(1.0, 0).rejected == 1
    pool.close()
    until(lambda: running(hanging) == [])


def test_full_queue_drops_and_counts_events() -> None:
    queue = EventQueue("events", capacity=2)
    assert [queue.put("x", 0.0) for _ in range(3)] == [True, True, False]
    state = queue.state(1.0, 0)
    assert (state.rejected, state.waiting) == (1, 2) and state.oldest > 1e9


def test_workers_end_when_their_parent_is_killed(tmp_path: Path) -> None:
    code = (
        "import sys, time\nfrom scan2sim.services.monitoring.work.local_workers import LocalWorkers\n"
        "from scan2sim.services.monitoring.work.queue import EventQueue\n"
        f"pool = LocalWorkers(EventQueue('q'), {WORKER!r})\npool.scale(2)\ntime.sleep(60)"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT)
    family = psutil.Process(parent.pid)
    until(lambda: len(family.children()) == 2)
    workers = family.children()
    parent.kill()
    parent.wait()
    until(lambda: not any(one.is_running() for one in workers))


def test_replicas_scale_and_are_restarted() -> None:
    programs = ProgramReplicas(["sleep", "1234"])
    programs.scale(3)
    until(lambda: programs.workers() == 3 and len(running(["sleep", "1234"])) == 3)
    first = running(["sleep", "1234"])[0]
    first.kill()
    until(lambda: not first.is_running() and len(running(["sleep", "1234"])) == 3)
    programs.scale(1)
    until(lambda: len(running(["sleep", "1234"])) == 1)
    programs.close()
    assert programs.workers() == 0 and running(["sleep", "1234"]) == []


def test_replicas_end_when_their_parent_is_killed(tmp_path: Path) -> None:
    """Also those that ignore SIGTERM, after a timeout, which is shorter here."""
    source, timeout = Path(supervise.__file__).read_text(encoding="utf-8"), f" = {supervise.STOP_TIMEOUT_S}"
    assert source.count(timeout) == 1
    hasty = tmp_path / "supervise.py"
    hasty.write_text(source.replace(timeout, " = 1.0"), encoding="utf-8")
    code = (
        "import time\nfrom scan2sim.services.monitoring.autoscale.actuators import supervise\n"
        "from scan2sim.services.monitoring.autoscale.actuators.replicas import ProgramReplicas\n"
        f"supervise.__file__ = {str(hasty)!r}\n"
        "programs = ProgramReplicas(['sh', '-c', 'trap \"\" TERM; sleep 4321'])\nprograms.scale(2)\ntime.sleep(60)"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT)
    until(lambda: len(running(["sleep", "4321"])) == 2)
    left = running(["sleep", "4321"])
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    until(lambda: not any(one.is_running() for one in left), 60)
