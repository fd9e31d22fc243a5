"""Native code in a child process: result, crash, exception, timeout."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from pathlib import Path

import psutil
import pytest

from scan2sim.pipeline.core import sandbox
from scan2sim.pipeline.core.errors import StepError

HERE = "tests.pipeline.core.test_sandbox"


def double(value: int) -> int:
    return 2 * value


def same(values: list[int]) -> list[int]:
    return values


def crash() -> None:
    os.kill(os.getpid(), signal.SIGSEGV)


def refuse() -> None:
    raise ValueError("no such luck")


def refuse_in_colour() -> None:
    raise RuntimeError("\x1b[1;31m[Open3D Error] no charts\n\x1b[0;m")


def return_beside_a_thread() -> int:
    """As of a native library that waits for its threads when it is freed."""
    threading.Thread(target=time.sleep, args=(600,)).start()
    return 42


def hang() -> None:
    time.sleep(600)


def test_result_of_the_child_is_returned() -> None:
    assert sandbox.call(f"{HERE}:double", 21, timeout=60) == 42


def test_a_child_runs_where_there_is_no_folder_for_temporary_files(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TMPDIR", "/nowhere")
    monkeypatch.setattr("tempfile.tempdir", "/nowhere")
    values = list(range(300_000))
    assert sandbox.call(f"{HERE}:same", values, timeout=60) == values


def test_paths_that_are_no_text_are_skipped_as_python_does(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", [*sys.path, Path("notebooks")])
    assert sandbox.call(f"{HERE}:double", 21, timeout=60) == 42


def test_crash_is_reported_as_an_error() -> None:
    with pytest.raises(StepError, match="crashed"):
        sandbox.call(f"{HERE}:crash", timeout=60)


def test_exception_of_the_child_is_reported() -> None:
    with pytest.raises(StepError, match="no such luck"):
        sandbox.call(f"{HERE}:refuse", timeout=60)


def test_last_line_of_a_coloured_error_is_reported() -> None:
    with pytest.raises(StepError, match=r"\[Open3D Error\] no charts") as raised:
        sandbox.call(f"{HERE}:refuse_in_colour", timeout=60)
    assert "\x1b" not in raised.value.cause


def test_threads_that_never_end_dont_hold_the_result() -> None:
    assert sandbox.call(f"{HERE}:return_beside_a_thread", timeout=60) == 42


def test_hanging_child_is_stopped_at_the_timeout() -> None:
    with pytest.raises(StepError, match="did not finish"):
        sandbox.call(f"{HERE}:hang", timeout=3)
    ours = [child.cmdline() for child in psutil.Process().children()]
    assert not [command for command in ours if "scan2sim.pipeline.core.sandbox" in command], "it is killed"
