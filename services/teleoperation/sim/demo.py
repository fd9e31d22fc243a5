"""Teleoperation demo on one machine: a simulated car in a finished world, driven from the station's page.

Starts the commands of gateway, station, vehicle adapter and vehicle, each a process, and joins car and station.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from scan2sim.pipeline.core.errors import StepError
from scan2sim.services.teleoperation.gateway.pki import certify
from scan2sim.services.teleoperation.settings import ADAPTER_PORT, GATEWAY_PORT, STATION_PORT, DemoParams

LOCALHOST = "127.0.0.1"
VEHICLE_NAME, STATION_NAME = "car", "desk"
START_TIMEOUT_S = 60.0
"""Timeout for each process to start."""


class Demo:
    """Processes of the demo, and URLs of its pages."""

    def __init__(self, params: DemoParams, folder: Path) -> None:
        """`folder`: of certificates, state and logs."""
        self.page = f"http://{LOCALHOST}:{params.port}/"
        self.fleet = f"http://{LOCALHOST}:{params.port + 1}/"
        self._params, self._folder = params, folder
        self._running: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, notify: Callable[[str], None]) -> None:
        """Start all processes, and join car and station.

        Raises:
            StepError: a process doesn't start; its log has the reason.
        """
        parties = self._folder / "parties"
        certify(parties, [LOCALHOST], [VEHICLE_NAME], [STATION_NAME])
        params, gateway = self._params, f"{LOCALHOST}:{GATEWAY_PORT}"
        notify("created the certificates")
        self._run(
            "gateway", parties / "gateway", "--listening", gateway, "--state", self._folder / "state",
            "--port", params.port + 1,
        )  # fmt: skip
        self._until("gateway", lambda: self._request("api/fleet") is not None)
        self._run(
            "station", parties / f"station-{STATION_NAME}", gateway, "--listening", f"{LOCALHOST}:{STATION_PORT}",
            "--port", params.port,
        )  # fmt: skip
        self._run("translate", "simulated", "--set", f"world={params.world}")
        views = [("front", 0), ("left", 90), ("right", -90), ("rear", 180)][: params.cameras]
        cameras = [part for name, turn in views for part in ("--camera", f"{name}=world:{params.world}@{turn}")]
        self._run(
            "vehicle", parties / f"vehicle-{VEHICLE_NAME}", gateway,
            "--link", f"one={LOCALHOST}", "--link", f"two={LOCALHOST}",
            "--translator", f"{LOCALHOST}:{ADAPTER_PORT}", "--rate", params.rate, *cameras,
        )  # fmt: skip
        self._until("vehicle", self._both_connected)
        self._request(f"api/vehicles/{VEHICLE_NAME}/join", {"station": STATION_NAME})
        notify(f"the driver page is {self.page}, the fleet page {self.fleet}")

    def ended(self) -> str | None:
        """Which process has ended, and the end of its log; None: all are running."""
        for name, process in self._running.items():
            if process.poll() is not None:
                return f"{name} has ended: {self._log(name).read_text().strip()[-300:]}"
        return None

    def close(self) -> None:
        """End all processes."""
        for process in reversed(self._running.values()):
            process.terminate()
        for process in self._running.values():
            try:
                process.wait(5.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def _run(self, name: str, *arguments: object) -> None:
        command = [sys.executable, "-m", "scan2sim.flows.cli", "teleop", name, *map(str, arguments)]
        with self._log(name).open("wb") as log:
            self._running[name] = subprocess.Popen(command, stdout=log, stderr=log, stdin=subprocess.DEVNULL)

    def _log(self, name: str) -> Path:
        return self._folder / f"{name}.log"

    def _until(self, name: str, condition: Callable[[], bool]) -> None:
        end = time.monotonic() + START_TIMEOUT_S
        while not condition():
            if (why := self.ended()) is not None or time.monotonic() > end:
                cause = why or f"has not started after {START_TIMEOUT_S:g} s"
                raise StepError(f"teleop {name}", cause, f"See {self._log(name)}")
            time.sleep(0.1)

    def _both_connected(self) -> bool:
        fleet = self._request("api/fleet") or {"vehicles": [], "stations": []}
        return all(any(one["there"] for one in fleet[kind]) for kind in ("vehicles", "stations"))

    def _request(self, path: str, body: dict[str, str] | None = None) -> dict[str, list[dict[str, object]]] | None:
        """Answer of the gateway's API; None: it doesn't answer."""
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(self.fleet + path, data, {"Content-Type": "application/json"})
        try:
            with urllib.request.urlopen(request, timeout=5) as answer:
                return dict(json.load(answer))
        except (urllib.error.URLError, ValueError, OSError):
            return None


@contextmanager
def demo(params: DemoParams, notify: Callable[[str], None]) -> Iterator[Demo]:
    """Run the demo, which ends with the block.

    Raises:
        StepError: a process doesn't start.
    """
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="scan2sim-teleop-"))
        running = Demo(params, Path(folder))
        stack.callback(running.close)
        running.start(notify)
        yield running
