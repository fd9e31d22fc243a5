"""Ctrl-C and SIGTERM end a service normally: what it opened is closed, nothing is printed, the exit code is 0."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("fastapi", reason="the extra bus isn't installed")
pytest.importorskip("OpenSSL", reason="the extra teleop isn't installed")

from scan2sim.flows.cli import KEEPING_STEPS
from scan2sim.services.teleoperation.gateway.pki import certify
from tests.conftest import ROOT
from tests.fakes.ports import free_port

SIGNALS = pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
SERVICE = """
import sys
from scan2sim.services.http import factory
from scan2sim.services.http.settings import ServerParams

params = ServerParams(port=0)
try:
    factory.run(factory.application("Test", params, alive={}), params, lambda url: print("ready", flush=True))
finally:
    print("closed")
"""


def stopped(command: list[str], number: signal.Signals, ready: str) -> tuple[int, str, str]:
    """Exit code, and what a program prints after it was stopped."""
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT) as process:
        assert process.stdout is not None
        try:
            assert any(ready in line for line in process.stdout), "it has ended"
            process.send_signal(number)
            output, errors = process.communicate(timeout=60)
        finally:
            process.kill()
    return process.returncode, output, errors


@SIGNALS
def test_stopped_service_closes_what_it_opened(number: signal.Signals) -> None:
    assert stopped([sys.executable, "-c", SERVICE], number, "ready") == (0, "closed\n", "")


@SIGNALS
def test_stopped_command_promises_no_results(number: signal.Signals, tmp_path: Path) -> None:
    certify(tmp_path, ["127.0.0.1"], [], [])
    options = ["--listening", f"127.0.0.1:{free_port()}", "--port", str(free_port()), "--state", str(tmp_path / "state")]
    arguments = ["teleop", "gateway", str(tmp_path / "gateway"), *options]
    command = [sys.executable, "-m", "scan2sim.flows.cli", *arguments]
    code, _, errors = stopped(command, number, "the fleet page is")
    assert (code, errors) == (0, "")


def test_services_keep_no_steps() -> None:
    assert not {"monitor", "toolbox", "qos", "orchestrate", "teleop", "camera", "view"} & set(KEEPING_STEPS)
