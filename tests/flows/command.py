"""The command `scan2sim`: run in the test's process, or in a process of its own (slower by the imports)."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from subprocess import CompletedProcess
from typing import Any

import pytest

from scan2sim.flows import cli
from scan2sim.flows.commands import display
from tests.conftest import ROOT

COLUMNS = "200"
"""Width of the output, so that no line is broken."""


def in_process(*arguments: object) -> CompletedProcess[str]:
    """Run `scan2sim` in this process."""
    stdout, stderr, code = StringIO(), StringIO(), 0
    command = ["scan2sim", *map(str, arguments)]
    assert display.console  # created before COLUMNS changes, or other tests in this process would get that width
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(stdout), redirect_stderr(stderr):
        patch.chdir(ROOT)
        patch.setenv("COLUMNS", COLUMNS)
        patch.setenv("PYTHONSAFEPATH", "1")
        patch.setattr(sys, "argv", command)
        try:
            cli.main()
        except SystemExit as ended:
            code = int(ended.code or 0)
    return CompletedProcess(command, code, stdout.getvalue(), stderr.getvalue())


def scan2sim(*arguments: object, timeout: float = 600) -> CompletedProcess[str]:
    """Run `scan2sim` in a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "scan2sim.flows.cli", *map(str, arguments)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=timeout,
        env=dict(os.environ, COLUMNS=COLUMNS),
    )


def stdout_of(result: CompletedProcess[str]) -> str:
    """Standard output of a command that must succeed."""
    assert result.returncode == 0, result.stderr + result.stdout
    return result.stdout


def assert_fails(result: CompletedProcess[str], code: int, *parts: str) -> None:
    """Assert that a command failed with an exit code and one message that contains all parts, without a traceback."""
    assert result.returncode == code, (result.returncode, result.stderr, result.stdout)
    for part in parts:
        assert part in result.stderr, result.stderr
    assert "Traceback" not in result.stderr + result.stdout
    assert len(result.stderr.strip().splitlines()) == 2, result.stderr


def options(settings: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Options `--set` for settings by step."""
    return [f"--set={step}.{name}={json.dumps(value)}" for step in settings for name, value in settings[step].items()]
