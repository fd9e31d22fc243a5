"""All of teleoperation on one machine: a car simulated in a finished world, driven from the station's page.

Starts the very commands that others start on their machines, each a process of its own, and joins them.
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
from scan2sim.services.teleoperation.settings import GATEWAY, STATION, DemoParams
from scan2sim.services.teleoperation.vehicle.adapter_protocol import PORT as TRANSLATOR

HERE = "127.0.0.1"
VEHICLE, DESK = "car", "desk"
STARTS_WITHIN = 60.0
"""Seconds for each part to be there."""


class Demo:
    """Its processes, and where its pages are."""

    def __init__(self, params: DemoParams, folder: Path) -> None:
        """`folder`: for certificates, state and logs."""
        self.page = f"http://{HERE}:{params.port}/"
        self.fleet = f"http://{HERE}:{params.port + 1}/"
        self._params, self._folder = params, folder
        self._running: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, say: Callable[[str], None]) -> None:
        """Start all parts, and join car and station.

        Raises:
            StepError: one doesn't start; its log says why.
        """
        parties = self._folder / "parties"
        certify(parties, [HERE], [VEHICLE], [DESK])
        params, gateway = self._params, f"{HERE}:{GATEWAY}"
        say("certificates are made")
        self._run(
            "gateway", parties / "gateway", "--listening", gateway, "--state", self._folder / "state",
            "--port", params.port + 1,
        )  # fmt: skip
        self._until("gateway", lambda: self._asked("api/fleet") is not None)
        self._run(
            "station", parties / f"station-{DESK}", gateway, "--listening", f"{HERE}:{STATION}", "--port", params.port
        )
        self._run("translate", "simulated", "--set", f"world={params.world}")
        views = [("front", 0), ("left", 90), ("right", -90), ("rear", 180)][: params.cameras]
        cameras = [part for name, turn in views for part in ("--camera", f"{name}=world:{params.world}@{turn}")]
        self._run(
            "vehicle", parties / f"vehicle-{VEHICLE}", gateway, "--link", f"one={HERE}", "--link", f"two={HERE}",
            "--translator", f"{HERE}:{TRANSLATOR}", "--rate", params.rate, *cameras,
        )  # fmt: skip
        self._until("vehicle", self._both_there)
        self._asked(f"api/vehicles/{VEHICLE}/join", {"station": DESK})
        say(f"the driver's page is {self.page}, fleet management {self.fleet}")

    def ended(self) -> str | None:
        """A part that has ended, and why."""
        for name, process in self._running.items():
            if process.poll() is not None:
                return f"{name} has ended: {self._log(name).read_text().strip()[-300:]}"
        return None

    def close(self) -> None:
        """End all parts."""
        for process in reversed(self._running.values()):
            process.terminate()
        for process in self._running.values():
            try:
                process.wait(5.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def _run(self, name: str, *words: object) -> None:
        command = [sys.executable, "-m", "scan2sim.flows.cli", "teleop", name, *map(str, words)]
        with self._log(name).open("wb") as log:
            self._running[name] = subprocess.Popen(command, stdout=log, stderr=log, stdin=subprocess.DEVNULL)

    def _log(self, name: str) -> Path:
        return self._folder / f"{name}.log"

    def _until(self, name: str, true: Callable[[], bool]) -> None:
        end = time.monotonic() + STARTS_WITHIN
        while not true():
            if (why := self.ended()) is not None or time.monotonic() > end:
                cause = why or f"isn't there after {STARTS_WITHIN:g} s"
                raise StepError(f"teleop {name}", cause, f"See {self._log(name)}")
            time.sleep(0.1)

    def _both_there(self) -> bool:
        told = self._asked("api/fleet") or {"vehicles": [], "stations": []}
        return all(any(one["there"] for one in told[kind]) for kind in ("vehicles", "stations"))

    def _asked(self, path: str, body: dict[str, str] | None = None) -> dict[str, list[dict[str, object]]] | None:
        """What the gateway's page answers; None: it doesn't."""
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(self.fleet + path, data, {"Content-Type": "application/json"})
        try:
            with urllib.request.urlopen(request, timeout=5) as answer:
                return dict(json.load(answer))
        except (urllib.error.URLError, ValueError, OSError):
            return None


@contextmanager
def demo(params: DemoParams, say: Callable[[str], None]) -> Iterator[Demo]:
    """A demonstration that runs, and ends with the block.

    Raises:
        StepError: a part doesn't start.
    """
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="scan2sim-teleop-"))
        made = Demo(params, Path(folder))
        stack.callback(made.close)
        made.start(say)
        yield made
