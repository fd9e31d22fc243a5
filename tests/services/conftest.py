"""Fixtures: an isolated DDS domain, and Python interpreters with each of the ROS 2 transports."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.fakes.interpreters import PYTHONS
from tests.fakes.ports import free_dds_domain

ROOT = Path(__file__).resolve().parents[2]

Start = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture(scope="session")
def domain() -> str:
    """A DDS domain that no other process of any test run uses."""
    return str(free_dds_domain())


@pytest.fixture(scope="session")
def pythons() -> dict[str, str]:
    """Python interpreters by the transport that is installed for them."""
    return {transport: str(python) for transport, python in PYTHONS.items() if python.exists()}


@pytest.fixture
def start(domain: str, pythons: dict[str, str], tmp_path: Path) -> Iterator[Start]:
    """Starts a program with a transport: `start("rclpy", "program", "argument")`; all are killed after the test."""
    running: list[subprocess.Popen[str]] = []

    def started(transport: str, *arguments: str | Path, **environment: str) -> subprocess.Popen[str]:
        if transport not in pythons:
            pytest.skip("rclpy isn't installed (.venv-ros, tests/services/ros-requirements.txt)")
        settings = {
            "SCAN2SIM_TRANSPORT": transport,
            "ROS_DOMAIN_ID": domain,
            "PYTHONPATH": str(ROOT),
            "XDG_STATE_HOME": str(tmp_path / "state"),
            **environment,
        }
        process = subprocess.Popen(
            [pythons[transport], *map(str, arguments)],
            env=os.environ | settings,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        running.append(process)
        return process

    yield started
    for process in running:
        process.kill()
    for process in running:
        with process:  # closes its pipes and waits
            pass
