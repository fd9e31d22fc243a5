"""Native code in a child process: result, crash, exception, timeout."""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path

import psutil
import pytest

from scan2sim.pipeline.core import sandbox
from scan2sim.pipeline.core.errors import StepError

HERE = "tests.pipeline.core.test_sandbox"


def double(value: int) -> int:
    return 2 * value


def crash() -> None:
    os.kill(os.getpid(), signal.SIGSEGV)


def refuse() -> None:
    raise ValueError("no such luck")


def hang() -> None:
    time.sleep(600)


def test_result_of_the_child_is_returned() -> None:
    assert sandbox.call(f"{HERE}:double", 21, timeout=60) == 42


def test_paths_that_are_no_text_are_skipped_as_python_does(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", [*sys.path, Path("notebooks")])
    assert sandbox.call(f"{HERE}:double", 21, timeout=60) == 42


def test_crash_is_reported_as_an_error() -> None:
    with pytest.raises(StepError, match="crashed"):
        sandbox.call(f"{HERE}:crash", timeout=60)


def test_exception_of_the_child_is_reported() -> None:
    with pytest.raises(StepError, match="no such luck"):
        sandbox.call(f"{HERE}:refuse", timeout=60)


def test_hanging_child_is_stopped_at_the_timeout() -> None:
    with pytest.raises(StepError, match="did not finish"):
        sandbox.call(f"{HERE}:hang", timeout=3)
    ours = [child.cmdline() for child in psutil.Process().children()]
    assert not [command for command in ours if "scan2sim.pipeline.core.sandbox" in command], "it is killed"
