"""Teleoperation's quality of service, measured: a scripted drive over an environment's network (D3.2, 2.2, table 6).

Vehicle and station are processes at the ends of two wires alike, four cameras send pictures that tell their time.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from scan2sim.pipeline.core.errors import StepError
from scan2sim.pipeline.core.step import Report
from scan2sim.services.qos.emulated_link import Link
from scan2sim.services.qos.environments import network
from scan2sim.services.qos.host_load import Machine, Usage, machine
from scan2sim.services.qos.link_profile import Shape
from scan2sim.services.qos.measure import FREE, STREET
from scan2sim.services.qos.requirements import Requirements
from scan2sim.services.teleoperation.control.messages import Kind
from scan2sim.services.teleoperation.gateway.pki import certify
from scan2sim.services.teleoperation.qos import scripted_drive
from scan2sim.services.teleoperation.qos.scripted_drive import HEIGHT, WIDTH, Setup
from scan2sim.services.teleoperation.settings import MeasureParams
from scan2sim.services.teleoperation.sim.route import aside

HERE = ("127.0.0.1", "127.0.0.2")
CAR, DESK = "car", "desk"
WIRES = 2
MORE = 1.1
"""Of a bit rate that is required, so much is asked of the encoders, which keep below it."""
WIRED = 1.15
"""Bytes on a wire for one of video: headers of RTP, SRTP, UDP, IP and Ethernet."""
FRAMES, PAN, NOISE = 60, 8, 4.0
"""Pictures that cameras show in turn, to and fro; pixels from one to the next; grey levels that a sensor is off by."""


@dataclass(frozen=True)
class Measured:
    """What was measured; times are ms.

    Attributes:
        vehicle, station: what the ends tell (`scripted`).
        seconds: that it took; wire_bytes: that crossed the network, both ways, overhead and all; None: there is none.
        usage: of the vehicle where it is measured on the robot, else of the station; machine: what that runs on.
    """

    vehicle: Mapping[str, Any]
    station: Mapping[str, Any]
    seconds: float
    wire_bytes: int | None
    usage: Usage
    machine: Machine

    def values(self) -> dict[str, float | None]:
        """By the metrics of `requirements.Requirements`; None: there is no such thing here."""
        ways = delays(self.vehicle["messages"], Kind.COMMAND)
        return {
            "response_time": percentile(list(responses(self.vehicle["messages"], self.station["obeyed"])), 95),
            "delay": percentile(ways, 95),
            "jitter": jitter(ways),
            "data_rate": self.station["seen"].get("bytes", 0) * 8e-6 / self.seconds,
            "bandwidth": None if self.wire_bytes is None else self.wire_bytes * 8e-6 / self.seconds,
            "loss_rate": self.loss_rate,
            "error_rate": self.error_rate,
            "cpu_cores": self.machine.cpu_cores,
            "cpu_frequency": self.machine.cpu_frequency,
            "cpu_usage": self.usage.cpu_percent,
            "gpu_cores": self.machine.gpu_cores,
            "gpu_frequency": self.machine.gpu_frequency,
            "gpu_memory": self.machine.gpu_memory,
            "gpu_usage": self.usage.gpu_percent,
            "memory": self.usage.memory_mb,
        }

    @property
    def loss_rate(self) -> float:
        """Share of all messages and packets of video that came by no link, or not before they were sent again."""
        received, missed, mended = (self.station["frames"].get(what, 0) for what in ("received", "lost", "mended"))
        came, lost = received - mended, missed + mended
        for end in (self.vehicle, self.station):
            came, lost = came + len(end["messages"]), lost + missing(end["messages"])
        return float(max(lost, 0) / max(came + lost, 1))

    @property
    def error_rate(self) -> float:
        """Share of what came that isn't as it was sent: pictures whose time can't be read, and malformed messages."""
        wrong = self.station["seen"].get("unreadable", 0)
        wrong += sum(end["counts"].get("malformed", 0) for end in (self.vehicle, self.station))
        came = len(self.station["glass"]) + sum(len(end["messages"]) for end in (self.vehicle, self.station))
        return float(wrong / max(came, 1))

    @property
    def glass_to_glass(self) -> list[float]:
        """From a picture's taking to its being decoded at the station, of each."""
        return [(seen - taken) / 1e6 for _, taken, seen in self.station["glass"]]

    @property
    def lost_frames(self) -> float:
        """Share of the frames that weren't shown."""
        shown, broken = self.station["frames"].get("frames", 0), self.station["frames"].get("broken", 0)
        return float(broken / max(shown + broken, 1))

    @property
    def aside(self) -> list[float]:
        """How far off its way along a street the vehicle was, m, every 0.1 m of it; nothing: it drove on a plain."""
        way = np.array(self.vehicle["way"])
        return np.abs(aside(way, self.vehicle["driven"])).tolist() if len(way) else []

    @property
    def command_gap(self) -> float:
        """The longest time without a command, as the car unit saw it."""
        return gap(self.vehicle["messages"], Kind.COMMAND)


Times = Sequence[Sequence[int]]
"""Messages: kind, number, sent, came (ns)."""


def delays(messages: Times, kind: Kind) -> list[float]:
    """On the way, ms, in the order of their sending."""
    return [(came - sent) / 1e6 for one, _, sent, came in sorted(messages, key=lambda each: each[1]) if one == kind]


def jitter(ways: Sequence[float]) -> float:
    """Mean difference of the delays of two in a row (RFC 3393)."""
    return float(np.abs(np.diff(ways)).mean()) if len(ways) > 1 else math.nan


def gap(messages: Times, kind: Kind) -> float:
    """The longest time between two, as they came, ms."""
    came = sorted(each[3] for each in messages if each[0] == kind)
    return float(np.diff(came).max()) / 1e6 if len(came) > 1 else math.inf


def missing(messages: Times) -> int:
    """Of those between the first and the last number, how many didn't come."""
    numbers = {each[1] for each in messages}
    return max(numbers) - min(numbers) + 1 - len(numbers) if numbers else 0


def responses(messages: Times, obeyed: Sequence[tuple[int, int]]) -> Iterator[float]:
    """From the sending of each command to the telemetry's coming that first tells of it, or of a later one, ms.

    Args:
        messages: that the vehicle heard.
        obeyed: numbers of commands that telemetry tells of, and when it came.
    """
    told = iter(sorted(obeyed, key=lambda one: one[1]))
    newest, came = -1, 0
    for kind, number, sent, _ in sorted(messages, key=lambda each: each[1]):
        if kind != Kind.COMMAND:
            continue
        while newest < number:
            try:
                newest, came = next(told)
            except StopIteration:
                return
        yield max(0, came - sent) / 1e6


def percentile(values: Sequence[float], share: float) -> float:
    """Of nothing, it is infinite: what never came is late."""
    return float(np.percentile(values, share)) if len(values) else math.inf


class End:
    """A process of `scripted`."""

    def __init__(self, role: str, setup: Setup, link: Link | None, log: Path) -> None:
        """Starts; `link`: the vehicle is at its near end, the station at its far one."""
        command = [sys.executable, "-m", scripted_drive.__name__, role, json.dumps(asdict(setup))]
        self._log, self._role = log, role
        with log.open("wb") as errors:
            named: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": errors}
            named |= {"text": True, "env": os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}}
            if link is None:
                self.process: subprocess.Popen[str] = subprocess.Popen(command, **named)
            else:
                self.process = (link.near if role == "vehicle" else link.far).popen(*command, **named)
        self.port = int(self._answer())

    def ask(self, word: str) -> Any:
        """Have it do something.

        Raises:
            StepError: it has failed.
        """
        assert self.process.stdin is not None
        try:
            self.process.stdin.write(f"{word}\n")
            self.process.stdin.flush()
        except OSError:
            pass  # it has ended: so says its answer
        return self._answer()

    def close(self) -> None:
        """End it."""
        self.process.kill()
        self.process.wait()

    def _answer(self) -> Any:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            said = self._log.read_text(errors="replace", encoding="utf-8").strip()[-600:]
            raise StepError(f"the scripted {self._role}", f"has failed: {said}", "Report it")
        return json.loads(line)


def quiet(fraction: float, message: str = "") -> None:
    """A report that nobody reads."""


class Pair:
    """A vehicle and a station that are there, and what is between them; see `pair`."""

    def __init__(self, vehicle: End, station: End, link: Link | None) -> None:
        self.vehicle, self.station, self.link = vehicle, station, link

    def begin(self) -> None:
        """Note from now on."""
        self.vehicle.ask("begin")
        self.station.ask("begin")

    def bytes(self) -> int | None:
        """That went through the wires so far, both ways."""
        if self.link is None:
            return None
        counts = [self.link.near.counts(wire) for wire in range(WIRES)]
        return sum(one.sent_bytes + one.received_bytes for one in counts)

    def measured(self, seconds: float, report: Report = quiet, *, robot: bool = False) -> Measured:
        """What becomes of a drive from now on for so long; `robot`: it is the vehicle's machine that counts."""
        measured = self.vehicle if robot else self.station
        self.begin()
        usage, before, began = Usage.of(psutil.Process(measured.process.pid)), self.bytes(), time.monotonic()
        while (took := time.monotonic() - began) < seconds:
            report(took / seconds, "the vehicle is driven")
            usage = usage.updated()
            time.sleep(min(0.1, seconds - took))
        usage, after, took = usage.updated(), self.bytes(), time.monotonic() - began
        crossed = None if before is None or after is None else after - before
        return Measured(self.vehicle.ask("told"), self.station.ask("told"), took, crossed, usage, machine())


@contextmanager
def pair(
    shapes: tuple[Shape, Shape] | None, setup: Setup, folder: Path, wires: Sequence[int] = range(WIRES)
) -> Iterator[Pair]:
    """A vehicle and a station that run, not yet joined.

    Args:
        shapes: of each wire, from the vehicle and to it; None: both ends are this machine, without a network.
        setup: of both; host, port, links and folder are filled in.
        folder: for certificates, state and logs.
        wires: that the vehicle has links by.

    Raises:
        UnavailableError: no network can be made here (it takes root).
        StepError: an end fails.
    """
    with ExitStack() as stack:
        link = None
        if shapes is not None:
            link = stack.enter_context(Link(*shapes, beside=[shapes] * (WIRES - 1)))
        host = HERE[0] if link is None else link.far.address
        parties = folder / "parties"
        certify(parties, [host], [CAR], [DESK])
        station = End("station", replace(setup, folder=str(parties), host=host), link, folder / "station.log")
        stack.callback(station.close)
        # by interface, not by address: all of them lead to the one address that the station listens on
        ways = [f"wire{wire}={HERE[wire] if link is None else link.near.interface(wire)}" for wire in wires]
        own = replace(
            setup, folder=str(parties / f"vehicle-{CAR}"), host=host, port=station.port, links=tuple(ways)
        )  # fmt: skip
        vehicle = End("vehicle", own, link, folder / "vehicle.log")
        stack.callback(vehicle.close)
        yield Pair(vehicle, station, link)


def measure(params: MeasureParams, required: Requirements, report: Report) -> Measured:
    """Drive by script over the environment's network.

    Raises:
        UnavailableError: no network can be made here (it takes root).
        StepError: an end fails, or they don't come together.
    """
    between = network(params.environment, params.network)
    shapes = None if between is None else (between.there, between.back)
    with tempfile.TemporaryDirectory(prefix="scan2sim-teleop-") as name:
        folder = Path(name)
        report(0.0, "pictures are made")
        setup = planned(params, required, None if between is None else between.there.rate)
        setup = replace(setup, pictures=str(film(folder / "pictures")))
        with pair(shapes, setup, folder) as ends:
            report(0.0, "vehicle and station are joined")
            ends.station.ask("join")
            ends.station.ask("drive")
            time.sleep(params.warm)
            return ends.measured(params.seconds, report, robot=between is None)


def planned(params: MeasureParams, required: Requirements, rate: float | None) -> Setup:
    """How video is sent: with the bits that are required; over all links where each carries all of it, else in turn.

    Args:
        rate: bit/s from the vehicle, of each wire; None: any.
    """
    asked = required.data_rate.value if required.data_rate is not None else 0.0
    bitrate = Setup.bitrate
    if params.bitrate is not None:
        bitrate = params.bitrate * 1e6
    elif asked:
        bitrate = MORE * asked * 1e6 / params.cameras
    share = rate is not None and WIRED * bitrate * params.cameras > FREE * rate
    world = "" if params.world is None else str(params.world)
    return Setup("", "", cameras=params.cameras, bitrate=bitrate, share=share, world=world)


def film(folder: Path) -> Path:
    """Pictures of the synthetic street, as a camera that is driven past it sees them.

    Returns:
        The folder.
    """
    import cv2

    folder.mkdir(parents=True)
    panorama = cv2.imread(str(sorted(STREET.rglob("*pano*.jpg"))[0]))
    assert panorama is not None
    scale, chance = HEIGHT / panorama.shape[0], np.random.default_rng(0)
    wide = cv2.resize(panorama, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    for number in range(FRAMES):
        left = PAN * min(number, FRAMES - number)
        picture = wide[:HEIGHT, left : left + WIDTH] + chance.normal(0.0, NOISE, (HEIGHT, WIDTH, 1))
        cv2.imwrite(str(folder / f"{number:03}.png"), picture.clip(0, 255).astype(np.uint8))
    return folder
