"""Workers are real processes: they start and stop as they are told, lose no event, and none outlives its maker."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import psutil

from scan2sim.services.monitoring.autoscale.actuators.local_workers import Processes
from scan2sim.services.monitoring.autoscale.actuators.replicas import Programs
from scan2sim.services.monitoring.example_nodes import worker
from scan2sim.services.monitoring.work.queue import EventQueue
from tests.conftest import ROOT

WORKER = worker.command(0.05)


def until(holds: Callable[[], bool], seconds: float = 30) -> bool:
    end = time.monotonic() + seconds
    while not holds() and time.monotonic() < end:
        time.sleep(0.02)
    return holds()


def running(command: list[str]) -> list[psutil.Process]:
    """Processes below this one that run a command."""
    found = []
    for process in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.Error):  # it has ended
            found += [process] * (process.cmdline() == command)
    return found


def test_workers_start_and_stop_and_do_all() -> None:
    queue = EventQueue("events")
    pool = Processes(queue, WORKER)
    for number in range(60):
        assert queue.put(str(number), time.time())
    pool.scale(3)
    assert until(lambda: pool.workers() == 3 and len(running(WORKER)) == 3)
    pool.scale(1)
    assert until(lambda: len(running(WORKER)) == 1)
    assert until(lambda: len(queue) == 0)
    state = queue.state(1.0, pool.workers())
    assert (state.arrived, state.done, state.refused, state.workers) == (60, 60, 0, 1)
    pool.close()
    assert running(WORKER) == []


def test_a_worker_that_is_killed_is_replaced_and_its_event_done() -> None:
    queue = EventQueue("events")
    slow = worker.command(0.5)
    pool = Processes(queue, slow)
    pool.scale(1)
    queue.put("a", time.time())
    assert until(lambda: queue.state(1.0, 0).waiting == 1 and len(running(slow)) == 1)
    time.sleep(0.2)
    running(slow)[0].kill()
    assert until(lambda: len(queue) == 0)
    assert queue.state(1.0, 0).refused == 0
    pool.close()


def test_a_worker_that_hangs_is_killed_and_an_event_that_kills_all_is_given_up() -> None:
    queue = EventQueue("events")
    hanging = worker.command(1000.0)
    pool = Processes(queue, hanging, deadline=0.2)
    queue.put("hangs", time.time())
    pool.scale(1)
    assert until(lambda: len(queue) == 0)
    assert queue.state(1.0, 0).refused == 1
    pool.close()
    assert running(hanging) == []


def test_a_full_queue_refuses_and_says_so() -> None:
    queue = EventQueue("events", most=2)
    assert [queue.put("x", 0.0) for _ in range(3)] == [True, True, False]
    state = queue.state(1.0, 0)
    assert (state.refused, state.waiting) == (1, 2) and state.oldest > 1e9


def test_no_worker_outlives_a_maker_that_is_killed(tmp_path: Path) -> None:
    code = (
        "import sys, time\nfrom scan2sim.services.monitoring.autoscale.actuators.local_workers import Processes\n"
        "from scan2sim.services.monitoring.work.queue import EventQueue\n"
        f"pool = Processes(EventQueue('q'), {WORKER!r})\npool.scale(2)\ntime.sleep(60)"
    )
    maker = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT)
    family = psutil.Process(maker.pid)
    assert until(lambda: len(family.children()) == 2)
    workers = family.children()
    maker.kill()
    maker.wait()
    assert until(lambda: not any(one.is_running() for one in workers))


def test_programs_start_and_stop_and_are_started_anew() -> None:
    programs = Programs(["sleep", "1234"])
    programs.scale(3)
    assert until(lambda: programs.workers() == 3 and len(running(["sleep", "1234"])) == 3)
    first = running(["sleep", "1234"])[0]
    first.kill()
    assert until(lambda: not first.is_running() and len(running(["sleep", "1234"])) == 3)
    programs.scale(1)
    assert until(lambda: len(running(["sleep", "1234"])) == 1)
    programs.close()
    assert programs.workers() == 0 and running(["sleep", "1234"]) == []


def test_no_program_outlives_a_maker_that_is_killed() -> None:
    code = (
        "import time\nfrom scan2sim.services.monitoring.autoscale.actuators.replicas import Programs\n"
        "programs = Programs(['sh', '-c', 'trap \"\" TERM; sleep 4321'])\nprograms.scale(2)\ntime.sleep(60)"
    )
    maker = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT)
    assert until(lambda: len(running(["sleep", "4321"])) == 2)
    left = running(["sleep", "4321"])
    maker.send_signal(signal.SIGKILL)
    maker.wait()
    assert until(lambda: not any(one.is_running() for one in left), 60)
