"""Teleoperation demo on one machine: a simulated car in a finished world, driven from the station's page.

Starts the commands of gateway, station, vehicle adapter and vehicle, each a process, and joins car and station. A
process that ends is started again; on Linux all end with the demo, even if it is killed. Their keys are in a temporary
folder, which is deleted at the end, or by the next demo if this one is killed.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from scan2sim.pipeline.core.errors import StepError
from scan2sim.pipeline.io.worlds.scene import read_scene
from scan2sim.services.teleoperation.adapter_key import ADAPTER_KEY_FILE
from scan2sim.services.teleoperation.gateway.pki import certify
from scan2sim.services.teleoperation.settings import ADAPTER_PORT, GATEWAY_PORT, STATION_PORT, DemoParams

LOCALHOST = "127.0.0.1"
VEHICLE_NAME, STATION_NAME = "car", "desk"
START_TIMEOUT_S = 60.0
"""Timeout for each process to start."""
RESTART_DELAY_MIN_S, RESTART_DELAY_MAX_S = 1.0, 15.0
"""Delay before a process that has ended is started again; it doubles with each restart."""
FOLDER_PREFIX, LOCK_FILE = "scan2sim-teleop-", "lock"
"""Temporary folders of demos, and the file in each that a running demo holds locked."""
CHILD = (
    "from scan2sim.pipeline.core.sandbox import die_with_parent; die_with_parent(); "
    "from scan2sim.flows.cli import main; main()"
)
"""Program of a process: a command that ends with its parent."""


@dataclass
class _Part:
    """A process of the demo.

    Attributes:
        restarts: how often it was started again; due: when it will be, s of the monotonic clock; None: it runs.
    """

    command: list[str]
    process: subprocess.Popen[bytes]
    restarts: int = 0
    due: float | None = None


class Demo:
    """Processes of the demo, and URLs of its pages."""

    def __init__(self, params: DemoParams, folder: Path) -> None:
        """`folder`: of certificates, state and logs."""
        self.page = f"http://{LOCALHOST}:{params.port}/"
        self.fleet = f"http://{LOCALHOST}:{params.port + 1}/"
        self._params, self._folder = params, folder
        self._parts: dict[str, _Part] = {}

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
            "--port", params.port, "--world", params.world,
        )  # fmt: skip
        car = parties / f"vehicle-{VEHICLE_NAME}"
        self._run("adapter", "simulated", "--set", f"world={params.world}", "--key", car / ADAPTER_KEY_FILE)
        cameras = [part for one in camera_options(params) for part in ("--camera", one)]
        self._run(
            "vehicle", car, gateway,
            "--link", f"one={LOCALHOST}", "--link", f"two={LOCALHOST}",
            "--adapter", f"{LOCALHOST}:{ADAPTER_PORT}", "--rate", params.rate, *cameras,
        )  # fmt: skip
        self._until("vehicle", self._both_connected)
        self._request(f"api/vehicles/{VEHICLE_NAME}/join", {"station": STATION_NAME})
        notify(f"the driver page is {self.page}, the fleet page {self.fleet}")

    def supervise(self, notify: Callable[[str], None]) -> None:
        """Start processes that have ended again; call this often. `notify` is called with what has ended and why."""
        now = time.monotonic()
        for name, part in self._parts.items():
            if part.due is None and part.process.poll() is not None:
                delay = min(RESTART_DELAY_MIN_S * 2**part.restarts, RESTART_DELAY_MAX_S)
                part.due, part.restarts = now + delay, part.restarts + 1
                notify(f"{self._reason(name)}; it starts again in {delay:.0f} s")
            elif part.due is not None and now >= part.due:
                part.due, part.process = None, self._popen(name, part.command)
                notify(f"{name} was started again; the vehicle stays stopped until its driver confirms")

    def close(self) -> None:
        """End all processes."""
        for part in reversed(self._parts.values()):
            part.process.terminate()
        for part in self._parts.values():
            try:
                part.process.wait(5.0)
            except subprocess.TimeoutExpired:
                part.process.kill()
                part.process.wait()

    def pids(self) -> dict[str, int]:
        """Process ids by command."""
        return {name: part.process.pid for name, part in self._parts.items()}

    def _run(self, name: str, *arguments: object) -> None:
        command = [sys.executable, "-c", CHILD, "teleop", name, *map(str, arguments)]
        self._parts[name] = _Part(command, self._popen(name, command))

    def _popen(self, name: str, command: list[str]) -> subprocess.Popen[bytes]:
        with self._log(name).open("ab") as log:
            return subprocess.Popen(command, stdout=log, stderr=log, stdin=subprocess.DEVNULL)

    def _ended(self) -> str | None:
        """Why a process has ended; None: all are running."""
        return next((self._reason(name) for name, part in self._parts.items() if part.process.poll() is not None), None)

    def _reason(self, name: str) -> str:
        """That a process has ended, how, and the end of its log."""
        code = self._parts[name].process.returncode
        how = f"was killed by signal {-code}" if code < 0 else f"has ended with exit status {code}"
        log = self._log(name).read_text(errors="replace").strip()[-300:]
        return f"{name} {how}: {log}" if code > 0 and log else f"{name} {how}"

    def _log(self, name: str) -> Path:
        return self._folder / f"{name}.log"

    def _until(self, name: str, condition: Callable[[], bool]) -> None:
        end = time.monotonic() + START_TIMEOUT_S
        while not condition():
            if (why := self._ended()) is not None or time.monotonic() > end:
                cause = why or f"has not started after {START_TIMEOUT_S:g} s"
                raise StepError(f"teleop {name}", cause, f"See {self._log(name)}")
            time.sleep(0.1)

    def _both_connected(self) -> bool:
        fleet = self._request("api/fleet") or {"vehicles": [], "stations": []}
        return all(any(one["connected"] for one in fleet[kind]) for kind in ("vehicles", "stations"))

    def _request(self, path: str, body: dict[str, str] | None = None) -> dict[str, list[dict[str, object]]] | None:
        """Answer of the gateway's API; None: it doesn't answer."""
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(self.fleet + path, data, {"Content-Type": "application/json"})
        try:
            with urllib.request.urlopen(request, timeout=5) as answer:
                return dict(json.load(answer))
        except (urllib.error.URLError, ValueError, OSError):
            return None


def camera_options(params: DemoParams) -> list[str]:
    """The car's cameras as options of the command `vehicle`: splats, if the world has any, or surfaces.

    Raises:
        InputError: the folder contains no world.
    """
    splats = not params.surfaces and read_scene(params.world).has_splats
    views = [("front", 0), ("left", 90), ("right", -90), ("rear", 180)][: params.cameras or (1 if splats else 4)]
    kind = "surfaces" if params.surfaces else "world"
    return [f"{name}={kind}:{params.world}@{turn}" for name, turn in views]


def delete_abandoned_folders(parent: Path) -> int:
    """Delete the folders, with keys and certificates, of demos that were killed; returns their number."""
    deleted = 0
    for folder in parent.glob(f"{FOLDER_PREFIX}*"):
        with contextlib.suppress(OSError):  # of another user, or locked: its demo is running
            if folder.stat().st_uid != os.getuid():
                continue
            with (folder / LOCK_FILE).open("rb") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder)
                deleted += 1
    return deleted


@contextmanager
def demo(params: DemoParams, notify: Callable[[str], None]) -> Iterator[Demo]:
    """Run the demo, which ends with the block; call `supervise` of the result meanwhile.

    Raises:
        StepError: a process doesn't start.
    """
    if deleted := delete_abandoned_folders(Path(tempfile.gettempdir())):
        notify(f"deleted the keys of {deleted} demo{'s' * (deleted > 1)} that had been killed")
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix=FOLDER_PREFIX)))
        lock = stack.enter_context((folder / LOCK_FILE).open("wb"))
        fcntl.flock(lock, fcntl.LOCK_EX)
        running = Demo(params, folder)
        stack.callback(running.close)
        running.start(notify)
        yield running
