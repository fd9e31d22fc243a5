"""Supervised threads: a failing job runs again and health says so; a dead thread ends the process."""

from __future__ import annotations

import logging
import signal
import subprocess
import sys
import threading

import pytest

from scan2sim.services import supervision
from scan2sim.services.supervision import SupervisedThread

PROGRAM = """
import threading, signal, sys
from scan2sim.services.supervision import end_process_with_threads
signal.signal(signal.SIGTERM, signal.default_int_handler)
try:
    with end_process_with_threads():
        threading.Thread(target=lambda: 1 / 0, name="reader").start()
        threading.Event().wait(60)
        sys.exit("still running")
except Exception as error:
    sys.exit(f"{error}")
"""


def test_a_job_that_fails_is_logged_and_runs_again(caplog: pytest.LogCaptureFixture) -> None:
    runs, done = list[int](), threading.Event()

    def job() -> None:
        runs.append(len(runs))
        if len(runs) < 3:
            raise ValueError("a broken record")
        done.set()

    thread = SupervisedThread(job, "reader")
    thread.start()
    assert done.wait(30)
    thread.join(30)
    assert runs == [0, 1, 2]
    assert [one.levelno for one in caplog.records] == [logging.ERROR] * 2 and "'reader' failed" in caplog.text


def test_health_fails_while_the_job_waits_to_run_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(supervision, "FIRST_RESTART_PAUSE_S", 60.0)
    fail, waiting = threading.Event(), threading.Event()

    def job() -> None:
        waiting.set()
        fail.wait(30)
        raise ValueError

    thread = SupervisedThread(job, "reader")
    thread.start()
    assert waiting.wait(30) and thread.is_alive()
    fail.set()
    while thread.is_alive():
        pass
    assert threading.Thread.is_alive(thread), "it only waits"
    thread.join(30)
    assert not threading.Thread.is_alive(thread), "a joined thread isn't restarted"


def test_a_job_runs_once_even_if_joined_at_once() -> None:
    ran = threading.Event()
    thread = SupervisedThread(ran.set, "reader")
    thread.start()
    thread.join()
    assert ran.is_set()


def test_a_dead_thread_ends_the_process_with_its_cause() -> None:
    ended = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, timeout=120)
    assert ended.returncode == 1 and "the thread 'reader' failed (ZeroDivisionError" in ended.stderr


def test_the_hook_is_restored() -> None:
    before = threading.excepthook, signal.getsignal(signal.SIGTERM)
    with supervision.end_process_with_threads():
        assert threading.excepthook is not before[0]
    assert (threading.excepthook, signal.getsignal(signal.SIGTERM)) == before


def test_a_server_in_a_thread_leaves_the_process_alone() -> None:
    hooks = list[object]()

    def serve() -> None:
        with supervision.end_process_with_threads():
            hooks.append(threading.excepthook)

    before = threading.excepthook
    thread = threading.Thread(target=serve)
    thread.start()
    thread.join(30)
    assert hooks == [before]
