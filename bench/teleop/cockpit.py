"""The driver's desk (parts of `bench.teleop`): frozen pictures, ignored brakes, unprotected starts.

Gateway, station and vehicle are the commands, the vehicle a car on a plain; the page is in headless Chromium, and a
relay between vehicle and station can be cut.
"""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from scan2sim.services.teleoperation.adapter_key import ADAPTER_KEY_FILE
from scan2sim.services.teleoperation.control.controls import Controls
from scan2sim.services.teleoperation.gateway.pki import certify
from scan2sim.services.teleoperation.qos.scripted_drive import PlainCar
from scan2sim.services.teleoperation.vehicle.adapter import AdapterParams, AdapterServer
from tests.fakes.browser import Page, chromium
from tests.fakes.driver_controls import hold
from tests.fakes.ports import free_port
from tests.fakes.relay import Relay

Report = Callable[[str], None]
HERE, HOSTS = "127.0.0.1", ("127.0.0.1", "127.0.0.2")
NOTICED_MS = 300.0
"""Time since the last proof of life within which the page must cover what is outdated."""
MAX_AGE_MS = 274.0
"""`MAX_AGE` of the page: what is drawn earlier is no cover."""
HANG_S, WAIT_S = 1.0, 120.0
"""Duration of a hang; time limit for everything else."""
LIMIT_MS = 1500.0
"""Maximum age of a command; generous, since the browser shares the processor."""
HANGS = ("station", "page", "vehicle", "link")
LIVE = "document.getElementById('status')?.textContent === 'live'"
LOG_COVERS = """
covers = []; drawn = drawCover;
drawCover = (canvas, text) => {
  covers.push([now(), cameras.get(0).captured, pageAlive, canvas === notice]);
  drawn(canvas, text);
};
0
"""
"""Script for the worker: records each cover with the last proofs of life."""
GAMEPADS = """
buttons = [0, 1].map(() => Array.from({length: 17}, () => ({value: 0, pressed: false, touched: false})));
navigator.getGamepads = () => [0, 1].map((index) => (
  {index, id: "emulated", connected: true, mapping: "standard", axes: [0, 0, 0, 0], buttons: buttons[index]}));
0
"""
THROTTLES, STOPS = (
    ("up", "W", "right trigger"),
    ("escape", "other gamepad's button B", "mouse on stop", "finger on stop"),
)
BRAKES = (
    "down", "S", "space", "left trigger", "other gamepad's left trigger", "mouse on brake", "finger on brake"
)  # fmt: skip


class Car(PlainCar):
    """A car on a plain; `controls` are its latest."""

    controls = Controls()

    def obey(self, controls: Controls) -> None:
        """See `adapters.Vehicle`."""
        self.controls = controls
        super().obey(controls)


class Desk:
    """A driver's desk with a vehicle.

    Attributes:
        station, vehicle: their processes; relay: the network between them; page: the driver page.
    """

    def __init__(
        self,
        folder: Path,
        stack: ExitStack,
        cameras: Sequence[str] = ("front=pattern:",),
        size: tuple[int, int] = (320, 240),
    ) -> None:
        """Start all of it; `cameras`: as option `--camera`; `size`: of their frames, pixels."""
        self.car, parties, ended = Car(), folder / "parties", threading.Event()
        certify(parties, [HERE], ["car"], ["desk"])
        key = parties / "vehicle-car" / ADAPTER_KEY_FILE
        adapter = AdapterServer(self.car, AdapterParams(port=0, key=key, limit=LIMIT_MS))
        thread = threading.Thread(target=adapter.run, args=(ended,))
        thread.start()
        stack.callback(thread.join)
        stack.callback(ended.set)
        gateway, fleet, udp, port = (free_port() for _ in range(4))
        self.relay = Relay((HERE, udp))
        stack.callback(self.relay.close)
        self._stack, self._folder, self._fleet = stack, folder, f"http://{HERE}:{fleet}/"
        state = folder / "state"
        self._run(
            "gateway", parties / "gateway", "--listening", f"{HERE}:{gateway}", "--state", state, "--port", fleet
        )  # fmt: skip
        self.station = self._run(
            "station", parties / "station-desk", f"{HERE}:{gateway}", "--listening", f"{HERE}:{udp}",
            "--reached", f"{HERE}:{self.relay.address[1]}", "--port", port,
        )  # fmt: skip
        self.vehicle = self._run(
            "vehicle", parties / "vehicle-car", f"{HERE}:{gateway}", "--adapter", f"{HERE}:{adapter.address[1]}",
            *(word for host in HOSTS for word in ("--link", f"{host}={host}")),
            *(word for camera in cameras for word in ("--camera", camera)), "--size", *size, "--limit", LIMIT_MS,
        )  # fmt: skip
        until(self._join)
        self.page = stack.enter_context(chromium(folder))
        self.page.do("Emulation.setTouchEmulationEnabled", enabled=True)
        self.page.do("Page.navigate", url=f"http://{HERE}:{port}/")
        self.page.until(LIVE, WAIT_S)

    def drive(self) -> None:
        """Take control if nobody has it, end an emergency stop, confirm, until the vehicle may move."""
        self.page.value("state.driver ?? byId('take').click(), send({do: 'unlatch'}), 0")
        end = time.monotonic() + WAIT_S
        while self.page.value("state.telemetry?.standing !== false"):
            if time.monotonic() > end:
                raise TimeoutError("the vehicle can't be driven: is this machine too busy?")
            self.page.value("byId('agree').disabled || byId('agree').click(), 0")
            time.sleep(0.5)

    def _join(self) -> bool:
        request = urllib.request.Request(
            f"{self._fleet}api/vehicles/car/join", b'{"station": "desk"}', {"Content-Type": "application/json"}
        )
        try:
            return urllib.request.urlopen(request, timeout=5).status == 200
        except OSError:
            return False

    def _run(self, *arguments: object) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "scan2sim.flows.cli", "teleop", *map(str, arguments)]
        with (self._folder / f"{arguments[0]}.log").open("wb") as log:
            process = subprocess.Popen(command, stdout=log, stderr=log)
        self._stack.callback(process.wait)
        self._stack.callback(process.kill)
        return process


@contextmanager
def desk() -> Iterator[Desk]:
    """A desk whose page is live."""
    with tempfile.TemporaryDirectory(prefix="bench-teleop-") as name, ExitStack() as stack:
        yield Desk(Path(name), stack)


def until(condition: Callable[[], bool]) -> bool:
    """Wait until a condition is true; False: it isn't within the time limit."""
    end = time.monotonic() + WAIT_S
    while not (found := condition()) and time.monotonic() < end:
        time.sleep(0.02)
    return found


def notice_ms(kind: str, page: Page) -> float:
    """Time from the last proof of life to the cover, ms; infinite: there was none."""
    found = page.worker_value("covers")
    if kind == "page":
        times = [at - alive for at, _, alive, notice in found if notice and at - alive > MAX_AGE_MS]
    else:
        times = [at - captured for at, captured, _, notice in found if not notice]
    return min(times, default=float("inf"))


def hang(kind: str, desk: Desk) -> tuple[float, bool]:
    """Let something hang; returns the time until it was noticed, ms, and whether nothing looked live at the end."""
    process = {"station": desk.station, "vehicle": desk.vehicle}.get(kind)
    desk.page.worker_value("covers.length = 0")
    if kind == "page":
        busy = f"const end = performance.now() + {HANG_S * 1e3}; while (performance.now() < end);"
        desk.page.value(f"setTimeout(() => {{ {busy} }}, 20), 0")
        time.sleep(HANG_S + 0.1)
        return notice_ms(kind, desk.page), True  # no script of the page runs meanwhile
    _stop(process, desk, True)
    time.sleep(HANG_S)
    link_up = "document.querySelector('#links [data-state=running]') !== null"
    shown = f"{LIVE} || byId('speed').textContent !== '-' || {link_up}"
    blank = not desk.page.value(shown)
    _stop(process, desk, False)
    return notice_ms(kind, desk.page), blank


def _stop(process: subprocess.Popen[bytes] | None, desk: Desk, stop: bool) -> None:
    if process is not None:
        os.kill(process.pid, signal.SIGSTOP if stop else signal.SIGCONT)
    for host in HOSTS if process is None else ():
        desk.relay.shapes[host].cut = stop


def stale(scale: float, report: Report) -> dict[str, Any]:
    """Hangs of station, page, vehicle and link: how many left something old that looked live after 300 ms, and 1 s."""
    each, wrong, never = max(3, round(50 * scale)), 0, 0
    with desk() as one:
        one.page.worker_value(LOG_COVERS)
        for kind in HANGS:
            times = list[float]()
            for _ in range(each):
                one.page.until(LIVE, WAIT_S)
                time.sleep(0.3)
                took, blank = hang(kind, one)
                times.append(took)
                wrong += took > NOTICED_MS or not blank
                never += took == float("inf") or not blank
            report(f"{kind} hangs {each} times: covered {min(times):.0f} to {max(times):.0f} ms after a sign of life")
    return {"stale_shown": wrong, "stale_after_1_s": never, "hangs": each * len(HANGS)}


def brakes(scale: float, report: Report) -> dict[str, Any]:
    """All pairs of a throttle and a brake, of two brakes, and of a throttle and an emergency stop, at the vehicle."""
    ignored, pairs = list[str](), 0
    with desk() as one:
        one.page.value(GAMEPADS)
        car = one.car
        for throttle, brake in itertools.product(THROTTLES, BRAKES + STOPS):
            pairs += 1
            one.drive()
            one.page.value("gamepad = null; 0")
            hold(one.page, throttle, True)
            drives = until(lambda: car.controls.throttle > 0.5)
            hold(one.page, brake, True)
            stopped = until(lambda: car.controls.brake > 0.9 and car.controls.throttle == 0)
            hold(one.page, brake, False)
            time.sleep(0.3 if brake in STOPS else 0.0)
            latched = brake not in STOPS or car.controls.brake == 1.0
            hold(one.page, throttle, False)
            if not (drives and stopped and latched):
                ignored.append(f"{brake} while {throttle}")
        for first, last in itertools.permutations(BRAKES, 2):
            if {first, last} == {"mouse on brake", "finger on brake"}:
                continue  # both press the same button
            pairs += 1
            one.drive()
            hold(one.page, first, True)
            hold(one.page, last, True)
            time.sleep(0.5)
            hold(one.page, first, False)
            time.sleep(0.2)
            if car.controls.brake < 0.9:
                ignored.append(f"{last}, after {first}")
            hold(one.page, last, False)
    report(f"{pairs} pairs of inputs; ignored: {', '.join(ignored) or 'none'}")
    return {"brakes_ignored": len(ignored), "brake_pairs": pairs}


def open_starts(scale: float, report: Report) -> dict[str, Any]:
    """Commands that start although nothing protects them."""
    with tempfile.TemporaryDirectory(prefix="bench-teleop-") as name:
        parties = Path(name) / "parties"
        certify(parties, [HERE], ["car"], ["desk"])
        (parties / "vehicle-car" / ADAPTER_KEY_FILE).unlink()
        everywhere = ("--host", "0.0.0.0", "--port", free_port())
        gateway = f"{HERE}:{free_port()}"
        starts: dict[str, tuple[object, ...]] = {
            "fleet page without token": (
                "gateway",
                parties / "gateway",
                "--state",
                name,
                "--listening",
                gateway,
                *everywhere,
            ),
            "gateway without certificate": ("gateway", Path(name) / "none", "--state", name),
            "driver page without token": ("station", parties / "station-desk", gateway, *everywhere),
            "station without certificate": ("station", Path(name) / "none", gateway),
            "adapter without key": ("adapter", "ros", *everywhere),
            "adapter without key, on loopback": ("adapter", "ros", "--port", free_port()),
            "onboard unit without key": ("vehicle", parties / "vehicle-car", gateway),
        }
        opened = list[str]()
        for what, words in starts.items():
            command = [sys.executable, "-m", "scan2sim.flows.cli", "teleop", *map(str, words)]
            try:
                done = subprocess.run(command, capture_output=True, text=True, timeout=60)
            except subprocess.TimeoutExpired:
                opened.append(what)
            else:
                report(f"{what}: {(done.stderr.strip().splitlines() or ['?'])[-1]:.150}")
    return {"open_starts": len(opened), "open_starts_tried": len(starts)}
